"""Procedural fans, blowing to the front."""

import numpy as np
from manifold3d import CrossSection

from experiments.simulation.solids import (
    Rng,
    Solids,
    assembled,
    ball,
    bar,
    box,
    capsule,
    one_of,
    ring_of,
    rod,
    sweep,
    torus,
    tube,
)

TURN = (-90, 0, 0)  # degrees that take z to the front, +y


def fan(rng: Rng) -> Solids:
    """Desk and pedestal fans, clip fans, box fans, and drums on a yoke."""
    makers = _desk, _pedestal, _box_fan, _drum
    return assembled(one_of(rng, makers, (0.3, 0.32, 0.18, 0.2)))


def _rotor(rng: Rng, radius: float, pitch: float | None = None) -> Solids:
    """Hub and blades about z, in the plane z = 0."""
    count, hub = int(rng.integers(3, 7)), radius * rng.uniform(0.14, 0.24)
    long, wide = radius - 0.5 * hub, radius * rng.uniform(0.35, 0.65) * 3 / (count + 1)
    angle = np.linspace(0, 2 * np.pi, 18, endpoint=False)
    swell = 1 + rng.uniform(-0.2, 0.5) * np.cos(angle)
    outline = np.stack([0.5 * long * np.cos(angle), wide * swell * np.sin(angle)], 1)
    section, thick = CrossSection([outline]), 0.025 * radius
    lean = rng.uniform(18, 38) if pitch is None else pitch
    blade = section.extrude(thick).translate((0, 0, -thick / 2)).rotate((lean, 0, 0))
    blades = ring_of(blade.translate((0.5 * hub + 0.5 * long, 0, 0)), count)
    tall = 0.16 * radius
    nose = ball((0, 0, tall * 0.6), (0.95 * hub, 0.95 * hub, 0.5 * hub), 16)
    return [rod((0, 0, -tall), (0, 0, 0.7 * tall), hub), nose, *blades]


def _guard(rng: Rng, radius: float, front: float, back: float, wire: float) -> Solids:
    """A cage of two dishes of wires about z and a band where they meet."""
    solids = [torus(radius, 1.4 * wire, segments=32, around=6)]
    count, style = int(rng.choice([10, 12, 16])), rng.random()
    for depth in (front, -back):
        middle, share = radius * rng.uniform(0.18, 0.28), np.linspace(0, 1, 5)
        reach = middle + (radius - middle) * share
        height = depth * np.sqrt(np.clip(1 - share**2.5, 0, 1))
        swirl = (0.0 if style < 0.6 else 0.5) * share
        path = np.stack([reach * np.cos(swirl), reach * np.sin(swirl), height], axis=1)
        section = wire * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2**0.5
        solids += ring_of(sweep(path, section), count)
        solids.append(rod((0, 0, depth - wire), (0, 0, depth + wire), 1.1 * middle))
        if style < 0.3:
            for ring_share in (0.4, 0.75):
                k = ring_share * 4
                size, z = (np.interp(k, range(5), values) for values in (reach, height))
                ring = torus(float(size), 0.8 * wire, segments=28, around=5)
                solids.append(ring.translate((0, 0, float(z))))
    return solids


def _head(rng: Rng, radius: float) -> Solids:
    """Motor, rotor and guard along z; the joint that carries it is at the origin."""
    forward, body = radius * rng.uniform(0.35, 0.5), radius * rng.uniform(0.22, 0.34)
    motor = [
        rod((0, 0, -0.5 * body), (0, 0, forward), body, 0.8 * body, 22),
        ball((0, 0, -0.5 * body), (body, body, 0.9 * body), 18),
    ]
    front, back = radius * rng.uniform(0.16, 0.28), radius * rng.uniform(0.16, 0.3)
    wire = max(0.013 * radius, 0.0022)
    parts = [*_rotor(rng, 0.86 * radius), *_guard(rng, radius, front, back, wire)]
    level = forward + back * 0.6
    motor.append(rod((0, 0, 0), (0, 0, level), 0.06 * radius, segments=10))
    return [*motor, *(part.translate((0, 0, level)) for part in parts)]


def _aimed(parts: Solids, tilt: float, point: tuple) -> Solids:
    """Turns z to the front, tilted up by so many degrees, the origin at a point."""
    return [part.rotate(TURN).rotate((tilt, 0, 0)).translate(point) for part in parts]


def _desk(rng: Rng) -> Solids:
    """On a short neck over a foot, or on a clip."""
    radius, tilt = rng.uniform(0.16, 0.22), rng.uniform(-5, 25)
    level = radius * rng.uniform(1.15, 1.5)
    head = _aimed(_head(rng, radius), tilt, (0, -0.35 * radius, level))
    neck, top = radius * rng.uniform(0.08, 0.16), (0, -0.35 * radius, level)
    solids = [*head, capsule((0, -0.1 * radius, 0.02), top, 1.4 * neck, neck)]
    wide = radius * rng.uniform(0.6, 0.85)
    style = str(rng.choice(["disc", "dome", "block", "clip"], p=[0.4, 0.25, 0.2, 0.15]))
    if style == "disc":
        solids.append(rod((0, 0, 0), (0, 0, 0.03), wide, 0.9 * wide, 32))
    elif style == "dome":
        dome = ball((0, 0, 0), (wide, 1.2 * wide, 0.4 * wide), 28)
        solids.append(dome.trim_by_plane((0, 0, 1), 0))
    elif style == "block":
        solids.append(box((0, 0, 0.03), (1.6 * wide, 1.3 * wide, 0.06), 0.015))
        for x in np.linspace(-0.5, 0.5, int(rng.integers(3, 6))) * wide:
            solids.append(box((x, 0.62 * wide, 0.06), (0.16 * wide, 0.12 * wide, 0.02)))
    else:
        solids.append(box((0, 0, 0.0), (0.5 * wide, 1.2 * wide, 0.02)))
        solids.append(box((0, 0.1 * wide, -0.07), (0.5 * wide, wide, 0.02)))
        solids.append(box((0, -0.5 * wide, -0.035), (0.4 * wide, 0.2 * wide, 0.08)))
    return solids


def _pedestal(rng: Rng) -> Solids:
    """On a telescopic pole over a plate, a cross or a tripod."""
    radius, tall = rng.uniform(0.18, 0.26), rng.uniform(0.85, 1.3)
    tilt, pole = rng.uniform(-8, 20), rng.uniform(0.012, 0.018)
    solids = _aimed(_head(rng, radius), tilt, (0, 0, tall))
    middle = tall * rng.uniform(0.4, 0.65)
    solids.append(rod((0, 0, 0), (0, 0, middle), 1.5 * pole, segments=16))
    solids.append(rod((0, 0, 0), (0, 0, tall), pole, segments=14))
    solids.append(rod((0, 0, middle), (0, 0, middle + 0.06), 2.2 * pole))
    if rng.random() < 0.6:
        case = (0, 0.02, tall - rng.uniform(0.18, 0.3))
        solids.append(box(case, (0.1, 0.08, rng.uniform(0.1, 0.2)), 0.012))
    wide = rng.uniform(0.2, 0.3)
    style = str(rng.choice(["plate", "cross", "tripod"], p=[0.5, 0.3, 0.2]))
    if style == "plate":
        solids.append(rod((0, 0, 0), (0, 0, 0.03), wide, 0.8 * wide, 32))
    elif style == "cross":
        solids += ring_of(bar((-wide, 0, 0.015), (wide, 0, 0.015), 0.03, 0.05), 2, 45.0)
        solids.append(rod((0, 0, 0), (0, 0, 0.07), 0.05, 0.03))
    else:
        solids += ring_of(bar((0, 0, 0.22), (1.2 * wide, 0, 0.01), 0.02, 0.03), 3, 90.0)
    return solids


def _box_fan(rng: Rng) -> Solids:
    """A square case with grilles on both sides, on feet, with a handle."""
    half, deep = rng.uniform(0.2, 0.28), rng.uniform(0.1, 0.16)
    radius, round_hole = 0.92 * half, rng.random() < 0.5
    case = box((0, 0, 0), (2 * half, deep, 2 * half), 0.1 * half)
    if round_hole:
        case -= rod((0, -1, 0), (0, 1, 0), radius, segments=40)
    else:
        case -= box((0, 0, 0), (1.86 * half, 1, 1.86 * half), 0.3 * half)
    rotor = [part.rotate(TURN) for part in _rotor(rng, 0.9 * radius)]
    motor = rod((0, -0.45 * deep, 0), (0, 0, 0), 0.25 * radius)
    solids, wire = [case, motor, *rotor], 0.014 * half
    bars = int(rng.integers(7, 12))
    for y in (-0.44 * deep, 0.44 * deep):
        for z in np.linspace(-0.85, 0.85, bars) * half:
            reach = np.sqrt(max(1.02 * radius**2 - z**2, 0)) if round_hole else radius
            solids.append(box((0, y, z), (2 * reach + wire, wire, 2 * wire)))
        solids.append(box((0, y, 0), (3 * wire, wire, 2 * radius)))
        solids.append(rod((0, y - wire, 0), (0, y + wire, 0), 0.2 * radius))
    for x in (-0.6 * half, 0.6 * half):
        foot = (x, 0, -half - 0.01)
        solids.append(box(foot, (0.08 * half, deep * rng.uniform(1.2, 2.0), 0.05)))
    if rng.random() < 0.6:
        angle = np.linspace(0, np.pi, 12)
        arc = 0.22 * half * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
        grip = 0.03 * half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        solids.append(sweep(arc, grip).translate((0, 0, 0.99 * half)))
    knob = (0.7 * half, 0.5 * deep, 0.8 * half)
    return [*solids, rod(knob, np.add(knob, (0, 0.03, 0)), 0.08 * half)]


def _drum(rng: Rng) -> Solids:
    """A short wide tube with a rotor in it, tilted in a yoke, on wheels in some."""
    radius, deep = rng.uniform(0.25, 0.42), rng.uniform(0.2, 0.3)
    wall, tilt = 0.035 * radius, rng.uniform(-5, 35)
    shell = tube((0, 0, -deep / 2), (0, 0, deep / 2), radius, radius - wall, 36)
    parts = [shell, *_rotor(rng, 0.88 * radius)]
    parts += [rod((0, 0, -0.6 * deep), (0, 0, 0), 0.24 * radius)]
    wire, count = 0.02 * radius, int(rng.choice([8, 10, 12]))
    for level in (-0.48 * deep, 0.48 * deep):
        spoke = rod((0, 0, level), (radius, 0, level), wire, segments=6)
        parts += [part for part in ring_of(spoke, count)]
        for share in (0.4, 0.7):
            ring = torus(share * radius, wire, segments=28, around=5)
            parts.append(ring.translate((0, 0, level)))
        parts.append(
            rod((0, 0, level - wire), (0, 0, level + wire), 0.15 * radius, segments=16)
        )
    level = radius * rng.uniform(1.15, 1.4)
    solids = _aimed(parts, tilt, (0, 0, level))
    side, pipe = 1.1 * radius, 0.05 * radius
    solids.append(rod((-side, 0, level), (-0.95 * radius, 0, level), pipe))
    solids.append(rod((0.95 * radius, 0, level), (side, 0, level), pipe))
    reach, low = 0.75 * radius, pipe
    for x in (-side, side):
        for y in (-reach, reach):
            solids.append(capsule((x, 0, level), (x, y, low), pipe, segments=10))
        solids.append(capsule((x, -reach, low), (x, reach, low), pipe, segments=10))
        if rng.random() < 0.5:
            solids.append(rod((x, 0, level), (1.15 * x, 0, level), 2 * pipe))
    for y in (-reach, reach):
        solids.append(capsule((-side, y, low), (side, y, low), pipe, segments=10))
    if rng.random() < 0.5:
        for x in (-side, side):
            ends = (x - 0.03, -reach, low + 0.03), (x + 0.03, -reach, low + 0.03)
            solids.append(rod(*ends, 2.6 * pipe, segments=20))
    return solids
