"""Procedural pumps, each with what drives it."""

import numpy as np
from manifold3d import CrossSection, Manifold

from experiments.simulation.shapes.drives import bolts, disc, motor
from experiments.simulation.shapes.plunger_pumps import foot, plunger_pump
from experiments.simulation.shapes.valves import flange
from experiments.simulation.solids import (
    Rng,
    assembled,
    ball,
    bar,
    box,
    capsule,
    lathe,
    one_of,
    ring_of,
    rod,
    tube,
    union,
)


def pump(rng: Rng) -> list[Manifold]:
    """Volute pumps on a base or close to their motor, in-line and multistage ones,
    diaphragm pumps, plunger pumps."""
    makers = _on_base, _close_coupled, _multistage, _inline, _diaphragm, plunger_pump
    return assembled(one_of(rng, makers, (0.28, 0.18, 0.16, 0.14, 0.12, 0.12)))


def _volute(rng: Rng, radius: float, deep: float) -> list[Manifold]:
    """Spiral case about z with its outlet up along y, its inlet along -z; both open."""
    angle = np.linspace(0, 2 * np.pi, 30)
    growth = radius * (0.72 + 0.28 * angle / (2 * np.pi))
    spiral = np.stack([growth * np.cos(angle), growth * np.sin(angle)], axis=1)
    section = CrossSection([spiral])
    case = section.extrude(deep).translate((0, 0, -deep / 2))
    bulge = rng.uniform(0.2, 0.45) * deep
    rounded = section.scale((0.9, 0.9)).extrude(deep + bulge)
    rounded = rounded.translate((0, 0, -(deep + bulge) / 2))
    pipe, out = 0.42 * deep, radius * rng.uniform(1.25, 1.6)
    x = 0.98 * radius - pipe
    neck = rod((x, 0, 0), (x, out, 0), 1.05 * pipe, 1.15 * pipe, 20)
    count, solids = int(rng.choice([0, 4, 6, 8])), [case, rounded, neck]
    solids += flange(
        (x, out - 0.25 * pipe, 0), (0, 1, 0), 1.9 * pipe, 0.4 * pipe, count
    )
    inlet, suction = 1.25 * pipe, -deep / 2 - radius * rng.uniform(0.35, 0.6)
    solids.append(rod((0, 0, suction), (0, 0, 0), inlet, 1.2 * inlet, 22))
    end = (0, 0, suction + 0.4 * pipe)
    solids += flange(end, (0, 0, -1), 1.75 * inlet, 0.4 * pipe, count)
    holes = rod((0, 0, suction - pipe), (0, 0, suction + 0.8 * radius), 0.75 * inlet)
    return [union(solids) - holes - rod((x, 0.6 * out, 0), (x, 2 * out, 0), 0.7 * pipe)]


def _to_front(parts: list[Manifold], point: tuple) -> list[Manifold]:
    """Turns y to z and z to -y, so that an inlet at -z looks to the front, +y."""
    return [part.rotate((90, 0, 0)).translate(point) for part in parts]


def _on_base(rng: Rng) -> list[Manifold]:
    """Pump, bearing bracket, coupling and motor in a row on a frame."""
    radius, deep = rng.uniform(0.13, 0.19), rng.uniform(0.09, 0.13)
    level = radius * rng.uniform(1.15, 1.35) + 0.1
    reach = radius * rng.uniform(1.6, 2.2)
    bracket = [
        rod((0, 0, 0), (0, 0, deep), 0.75 * radius, 0.62 * radius, 26),
        rod((0, 0, deep), (0, 0, reach), 0.5 * radius, 0.36 * radius, 24),
        disc(0.45 * radius, reach - 0.04, reach, 24),
        disc(0.13 * radius, reach, reach + 0.16),
        *bolts(8, 0.72 * radius, 0.012, 0.4 * deep, 0.6 * deep),
    ]
    gap, hub = reach + 0.03, radius * rng.uniform(0.25, 0.38)
    coupling = [disc(hub, gap, gap + 0.05), disc(hub, gap + 0.06, gap + 0.11)]
    if rng.random() < 0.55:
        coupling = [
            box((0, 0.15 * hub, gap + 0.06), (2.6 * hub, 2.6 * hub, 0.15), 0.6 * hub),
            box((0, -level / 2 + 0.05, gap + 0.06), (2.4 * hub, level - 0.1, 0.13)),
        ]
    size, long = radius * rng.uniform(0.75, 1.05), rng.uniform(0.36, 0.5)
    drive = [p.rotate((0, 0, 90)) for p in motor(rng, size, long)]
    drive = [part.translate((0, 0, gap + 0.11)) for part in drive]
    solids = _to_front(
        [*_volute(rng, radius, deep), *bracket, *coupling, *drive], (0, 0.35, level)
    )
    total, low = gap + 0.11 + long, 0.1
    solids += foot((0, 0.35, level - 0.4 * radius), (1.6 * radius, 0.12), low)
    solids += foot((0, 0.35 - 0.85 * reach, level - 0.25 * radius), (radius, 0.06), low)
    middle = 0.35 - gap - 0.11 - 0.42 * long
    for y in (middle - 0.2 * long, middle + 0.2 * long):
        solids += foot((0, y, level - 0.7 * size), (2.1 * size, 0.05), low)
    half = max(1.2 * radius, 1.15 * size)
    long_base, center = total + radius, 0.35 + 0.25 * radius - total / 2
    if rng.random() < 0.5:
        solids.append(box((0, center, 0.05), (2 * half, long_base, 0.1), 0.01))
    else:
        for x in (-half, half):
            solids.append(box((0.85 * x, center, 0.05), (0.05, long_base, 0.1)))
        for y in np.linspace(-0.48, 0.48, 4) * long_base:
            solids.append(box((0, center + y, 0.06), (1.7 * half, 0.06, 0.09)))
        solids.append(box((0, center, 0.098), (1.75 * half, long_base, 0.014)))
    return solids


def _close_coupled(rng: Rng) -> list[Manifold]:
    """The case on the motor's own flange; feet under the motor or the case."""
    radius, deep = rng.uniform(0.11, 0.16), rng.uniform(0.08, 0.12)
    size, long = radius * rng.uniform(0.75, 1.05), rng.uniform(0.28, 0.42)
    lantern, parts = radius * rng.uniform(0.3, 0.8), _volute(rng, radius, deep)
    parts.append(disc(0.85 * radius, 0.0, 0.7 * deep, 28))
    parts += bolts(8, 0.75 * radius, 0.01, 0.5 * deep, 0.8 * deep)
    if rng.random() < 0.5:
        parts.append(
            rod((0, 0, 0.5 * deep), (0, 0, deep + lantern), 0.7 * radius, size, 26)
        )
    else:
        parts.append(disc(0.2 * radius, 0.0, deep + lantern))
        arm = bar((0.6 * radius, 0, 0.5 * deep), (size, 0, deep + lantern), 0.05, 0.03)
        parts += [
            *ring_of(arm, 4, 45.0),
            disc(size, deep + lantern - 0.02, deep + lantern),
        ]
    drive, start = motor(rng, size, long), deep + lantern - 0.005
    parts += [p.rotate((0, 0, 90)).translate((0, 0, start)) for p in drive]
    level = 1.25 * max(radius, size)
    solids = _to_front(parts, (0, 0.2, level))
    if rng.random() < 0.7:
        middle = 0.2 - start - 0.42 * long
        for y in (middle - 0.2 * long, middle + 0.2 * long):
            solids += foot((0, y, level - 0.6 * size), (2.0 * size, 0.05), 0.0)
    if rng.random() < 0.6:
        solids += foot((0, 0.2, level - 0.4 * radius), (1.5 * radius, 0.1), 0.0)
    return solids


def _multistage(rng: Rng) -> list[Manifold]:
    """A slim column of stages on an in-line foot, its motor on top."""
    radius, count = rng.uniform(0.07, 0.1), int(rng.integers(3, 9))
    pipe, half = 0.5 * radius, radius * rng.uniform(1.6, 2.2)
    low, stage = 1.3 * radius, radius * rng.uniform(0.4, 0.55)
    solids = [rod((-half, 0, low), (half, 0, low), 1.2 * pipe, segments=20)]
    number = int(rng.choice([0, 4]))
    for side in (-1, 1):
        start = (side * (half - 0.3 * pipe), 0, low)
        solids += flange(start, (side, 0, 0), 2.1 * pipe, 0.5 * pipe, number)
    solids = [union(solids) - rod((-1, 0, low), (1, 0, low), 0.75 * pipe)]
    solids.append(disc(1.15 * radius, 0.0, 1.9 * low))
    solids.append(box((0, 0, 0.02), (3.0 * radius, 3.2 * radius, 0.04), 0.008))
    top = 1.9 * low + count * stage
    solids.append(disc(0.85 * radius, low, top))
    if rng.random() < 0.6:
        for k in range(count):
            level = 1.9 * low + k * stage
            solids.append(disc(radius, level + 0.1 * stage, level + 0.75 * stage, 26))
    else:
        solids.append(disc(0.98 * radius, 1.5 * low, top, 28))
    strap = bar((1.12 * radius, 0, low), (1.12 * radius, 0, top + 0.03), 0.012, 0.03)
    solids += ring_of(strap, 4, 45.0)
    solids.append(disc(1.35 * radius, top, top + 0.04, 28))
    head = radius * rng.uniform(0.9, 1.4)
    for side in (-1, 1):
        size = (0.25 * radius, 1.5 * radius, head)
        solids.append(box((side * 0.95 * radius, 0, top + head / 2), size))
    solids.append(disc(0.3 * radius, top, top + head))
    solids.append(disc(1.3 * radius, top + head - 0.02, top + head + 0.02, 28))
    drive = motor(rng, radius * rng.uniform(1.0, 1.3), rng.uniform(0.24, 0.36))
    return solids + [part.translate((0, 0, top + head + 0.01)) for part in drive]


def _inline(rng: Rng) -> list[Manifold]:
    """A round case between two flanges of one pipe, the motor upright or lying."""
    radius, pipe = rng.uniform(0.1, 0.15), rng.uniform(0.035, 0.05)
    half, level = radius * rng.uniform(1.6, 2.1), rng.uniform(1.2, 1.6) * radius
    solids = [rod((-half, 0, 0), (half, 0, 0), 1.25 * pipe, segments=20)]
    solids += [ball((0, 0, 0), (radius, radius, 0.8 * radius), 26)]
    count = int(rng.choice([0, 4, 8]))
    for side in (-1, 1):
        start = (side * (half - 0.5 * pipe), 0, 0)
        solids += flange(start, (side, 0, 0), 2.2 * pipe, 0.5 * pipe, count)
    bore = [rod((s * 0.8 * radius, 0, 0), (s, 0, 0), 0.8 * pipe) for s in (-1, 1)]
    solids = [union(solids) - union(bore)]
    parts = [disc(0.9 * radius, 0.3 * radius, 0.75 * radius, 28)]
    parts += bolts(8, 0.8 * radius, 0.01, 0.5 * radius, 0.82 * radius)
    size, long = radius * rng.uniform(0.65, 0.95), rng.uniform(0.22, 0.36)
    parts.append(
        rod((0, 0, 0.7 * radius), (0, 0, 1.2 * radius), 0.8 * radius, size, 26)
    )
    drive = motor(rng, size, long)
    parts += [part.translate((0, 0, 1.19 * radius)) for part in drive]
    if rng.random() < 0.35:
        parts, level = [part.rotate((90, 0, 0)) for part in parts], 1.5 * radius
    solids = [part.translate((0, 0, level)) for part in (*solids, *parts)]
    if rng.random() < 0.75:
        wide = rng.uniform(1.6, 2.4) * radius
        solids.append(disc(0.5 * radius, 0.0, level - 0.5 * radius))
        solids.append(box((0, 0, 0.015), (wide, wide, 0.03), 0.008))
    return solids


def _diaphragm(rng: Rng) -> list[Manifold]:
    """Two round chambers side by side, joined by pipes above and below; feet."""
    radius, gap = rng.uniform(0.13, 0.19), rng.uniform(0.12, 0.18)
    level, pipe = radius * rng.uniform(1.35, 1.6), radius * rng.uniform(0.16, 0.22)
    dome = lathe(
        [(1.0, 0), (1.0, 0.14), (0.86, 0.16), (0.7, 0.34), (0.3, 0.42)], 30
    ).scale((radius, radius, radius))
    parts = [dome, *bolts(10, 0.93 * radius, 0.06 * radius, 0.0, 0.2 * radius)]
    solids = []
    for side in (-1, 1):
        turned = [part.rotate((0, 90 * side, 0)) for part in parts]
        solids += [part.translate((side * gap / 2, 0, level)) for part in turned]
    solids.append(box((0, 0, level), (gap + 0.02, 1.1 * radius, 1.5 * radius), 0.03))
    out = gap / 2 + 0.25 * radius
    for sign in (-1, 1):
        height = level + sign * 1.18 * radius
        solids.append(capsule((-out, 0, height), (out, 0, height), pipe, segments=14))
        solids += [rod((x, 0, level), (x, 0, height), 1.15 * pipe) for x in (-out, out)]
        port = (0, 0.9 * radius, height)
        solids.append(tube((0, 0, height), port, pipe, 0.7 * pipe, 18))
        start = (0, 0.9 * radius - 0.5 * pipe, height)
        solids += flange(start, (0, 1, 0), 1.8 * pipe, 0.5 * pipe, 4, 0.7 * pipe)
    for x in (-out, out):
        solids.append(box((x, 0, 0.012), (0.5 * radius, 1.3 * radius, 0.024)))
        for y in (-0.35 * radius, 0.35 * radius):
            leg = (x, y, 0), (x, 0.8 * y, level - 0.7 * radius)
            solids.append(bar(*leg, 0.2 * radius, 0.03))
    if rng.random() < 0.6:
        case = (0, -0.6 * radius, level + 0.2 * radius)
        solids.append(box(case, (0.7 * gap, 0.5 * radius, 0.5 * radius), 0.02))
        solids.append(rod(case, np.add(case, (0, -0.5 * radius, 0)), 0.12 * radius))
    return solids
