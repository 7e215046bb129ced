"""Procedural tanks."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.shapes.drives import motor
from experiments.simulation.shapes.tank_parts import (
    around,
    hopper,
    manhole,
    nozzle,
    rungs,
)
from experiments.simulation.shapes.valves import flange
from experiments.simulation.solids import (
    Rng,
    assembled,
    ball,
    bar,
    box,
    corners,
    lathe,
    one_of,
    ring_of,
    rod,
    torus,
)


def tank(rng: Rng) -> list[Manifold]:
    """Upright vessels on legs or a skirt, lying ones on saddles, hoppers in a frame,
    caged containers; with nozzles, manholes, ladders, gauges and agitators."""
    makers = _upright, _lying, hopper, _caged
    return assembled(one_of(rng, makers, (0.36, 0.28, 0.2, 0.16)))


def _head_profile(radius: float, tall: float, style: str) -> list[tuple[float, float]]:
    """(radius, z) pairs from the rim at z = 0 up to the middle at `tall`."""
    if style == "cone":
        return [(radius, 0.0), (0.06 * radius, tall)]
    if style == "flat":
        return [(radius, 0.0), (radius, 0.02 * radius)]
    angle = np.linspace(0, 0.48 * np.pi, 7)
    return [(radius * np.cos(a), tall * np.sin(a)) for a in angle]


def _vessel(
    rng: Rng, radius: float, long: float, bottom: str, top: str
) -> tuple[Manifold, float, float]:
    """Shell about z from z = 0 to `long`; how far its ends reach below and above."""
    drops = {
        "cone": rng.uniform(0.5, 1.1),
        "dished": rng.uniform(0.25, 0.5),
        "flat": 0.02,
    }
    below, above = drops[bottom] * radius, drops[top] * radius
    if top == "cone":
        above *= 0.4
    low = [(r, -z) for r, z in _head_profile(radius, below, bottom)][::-1]
    high = _head_profile(radius, above, top)
    high = [(r, long + z) for r, z in high]
    return lathe([*low, *high], 36), below, above


def _upright(rng: Rng) -> list[Manifold]:
    """Legs, a skirt or the floor below; dished, conical or flat ends."""
    radius, slim = rng.uniform(0.4, 0.65), rng.uniform(1.2, 3.2)
    long = radius * slim
    support = str(rng.choice(["legs", "skirt", "floor"], p=[0.55, 0.25, 0.2]))
    bottom = "flat" if support == "floor" else str(rng.choice(["dished", "cone"]))
    top = str(rng.choice(["dished", "cone", "flat"], p=[0.6, 0.25, 0.15]))
    shell, below, above = _vessel(rng, radius, long, bottom, top)
    free = 0.0 if support == "floor" else below + rng.uniform(0.15, 0.5)
    solids, high = [shell.translate((0, 0, free))], free + long
    if support == "legs":
        solids += _legs(rng, radius, free + 0.12 * long, int(rng.choice([3, 4, 4, 6])))
    elif support == "skirt":
        skirt = rod((0, 0, 0), (0, 0, free + 0.05), 1.08 * radius, radius, 36)
        hole = rod((0, 0, 0.22), (0, 2, 0.22), rng.uniform(0.08, 0.14))
        solids += [skirt - hole, rod((0, 0, 0), (0, 0, 0.04), 1.15 * radius)]
    if support != "floor":
        drain = np.array((0.0, 0.0, free - below))
        solids += nozzle(rng, drain, np.array((0, 0, -1.0)), 0.05, 0.12)
    for level in np.linspace(0.08, 0.95, int(rng.integers(0, 5))) * long:
        band = torus(radius, 0.018, segments=36, around=6)
        solids.append(band.translate((0, 0, free + level)))
    solids += _sides(rng, radius, free, high)
    return solids + _roof(rng, radius, high, above)


def _legs(rng: Rng, radius: float, tall: float, count: int) -> list[Manifold]:
    """Posts on plates around a vessel, with braces in some."""
    thick, is_round = rng.uniform(0.045, 0.08), rng.random() < 0.5
    x = radius * rng.uniform(0.92, 1.02)
    foot, top = np.array((x, 0.0, 0.0)), np.array((x, 0.0, tall))
    leg = (
        rod(foot, top, thick, segments=14)
        if is_round
        else bar(foot, top, 2 * thick, thick)
    )
    solids = ring_of(leg, count, 180 / count)
    plate = box((x, 0, 0.012), (4 * thick, 4 * thick, 0.024))
    solids += ring_of(plate, count, 180 / count)
    if rng.random() < 0.4:
        level, turn = rng.uniform(0.25, 0.5) * tall, 2 * np.pi / count
        near = x * np.array((1, 0, 0)) + (0, 0, level)
        far = x * np.array((np.cos(turn), np.sin(turn), 0)) + (0, 0, level)
        solids += ring_of(rod(near, far, 0.022, segments=8), count, 180 / count)
    return solids


def _sides(rng: Rng, radius: float, low: float, high: float) -> list[Manifold]:
    """Nozzles, a manhole, a gauge and a ladder on a shell about z."""
    solids, tall = [], high - low
    for _ in range(int(rng.integers(1, 5))):
        level = low + tall * rng.uniform(0.1, 0.9)
        root, out = around(rng.uniform(-1.4, 1.4) * np.pi / 2, radius, level)
        size = rng.uniform(0.03, 0.07)
        solids += nozzle(rng, root, out, size, rng.uniform(0.1, 0.2))
    if rng.random() < 0.45:
        root, out = around(rng.choice([0.0, 0.6, -0.6]), 0.97 * radius, low + 0.35)
        solids += manhole(root, out, rng.uniform(0.18, 0.24))
    if rng.random() < 0.4:
        ends = []
        for share in (0.15, 0.85):
            root, out = around(np.pi / 4, radius, low + share * tall)
            ends.append(root + 0.12 * out)
            solids.append(rod(root - 0.05 * out, ends[-1], 0.02, segments=10))
        solids.append(rod(ends[0], ends[1], 0.025, segments=10))
    if rng.random() < 0.4:
        caged = rng.random() < 0.5
        solids += rungs(-np.pi / 2, radius, 0.0, high + 0.3, caged)
    return solids


def _roof(rng: Rng, radius: float, high: float, above: float) -> list[Manifold]:
    """An agitator or a nozzle in the middle, more around it, a railing in some."""
    up, top = np.array((0, 0, 1.0)), np.array((0.0, 0.0, high + above))
    solids, style = [], rng.random()
    if style < 0.35:
        neck = top[2] + rng.uniform(0.1, 0.25)
        solids.append(rod(top - (0, 0, 0.1), (0, 0, neck), 0.11, segments=18))
        solids += flange((0, 0, neck - 0.03), up, 0.17, 0.04, 8)
        drive = motor(rng, rng.uniform(0.1, 0.15), rng.uniform(0.3, 0.45))
        solids += [part.translate((0, 0, neck)) for part in drive]
    elif style < 0.75:
        solids += nozzle(rng, top - (0, 0, 0.04), up, rng.uniform(0.05, 0.09), 0.16)
    for _ in range(int(rng.integers(0, 4))):
        angle, share = rng.uniform(0, 2 * np.pi), rng.uniform(0.45, 0.7)
        spot, _ = around(angle, share * radius, high)
        drop = spot + (0, 0, 0.3 * above)
        solids += nozzle(rng, drop, up, rng.uniform(0.03, 0.06), 0.7 * above + 0.1)
    if style > 0.75:
        spot, _ = around(rng.choice([0.0, np.pi]), 0.5 * radius, high + 0.5 * above)
        solids += manhole(spot, up, 0.2)
        edge, level = radius - 0.03, high - 0.03
        post = rod((edge, 0, level), (edge, 0, high + 0.5), 0.016, segments=8)
        solids += ring_of(post, 10)
        for tall in (0.25, 0.5):
            rail = torus(edge, 0.016, segments=32, around=6)
            solids.append(rail.translate((0, 0, high + tall)))
    return solids


def _lying(rng: Rng) -> list[Manifold]:
    """A vessel along x on two or three saddles, fittings above and at its ends."""
    radius, slim = rng.uniform(0.35, 0.55), rng.uniform(2.2, 4.5)
    long, level = radius * slim, radius + rng.uniform(0.12, 0.4)
    shell, _, above = _vessel(rng, radius, long, "dished", "dished")
    shell = shell.translate((0, 0, -long / 2)).rotate((0, 90, 0))
    solids = [shell.translate((0, 0, level))]
    wide, thick = radius * rng.uniform(0.8, 0.95), rng.uniform(0.08, 0.14)
    for x in np.linspace(-0.34, 0.34, 2 if rng.random() < 0.8 else 3) * long:
        solids.append(box((x, 0, level / 2), (0.5 * thick, 2 * wide, level)))
        solids.append(box((x, 0, 0.02), (1.8 * thick, 2.2 * wide, 0.04)))
        half = box((x, 0, level - 0.6 * radius), (thick, 2.2 * radius, 1.0 * radius))
        ring = rod(
            (x - thick, 0, level), (x + thick, 0, level), 1.05 * radius, segments=36
        )
        solids.append(ring ^ half)
    up = np.array((0, 0, 1.0))
    for x in np.linspace(-0.4, 0.4, int(rng.integers(2, 6))) * long:
        root, size = np.array((x, 0, level + radius - 0.02)), rng.uniform(0.03, 0.07)
        solids += nozzle(rng, root, up, size, rng.uniform(0.1, 0.2))
    if rng.random() < 0.65:
        spot = np.array((rng.uniform(-0.2, 0.2) * long, 0.0, level + 0.96 * radius))
        if rng.random() < 0.7:
            solids += manhole(spot, up, rng.uniform(0.18, 0.24))
        else:
            solids.append(ball(spot, (0.5 * radius, 0.5 * radius, 0.45 * radius), 24))
            solids += nozzle(rng, spot + (0, 0, 0.42 * radius), up, 0.05, 0.12)
    end = np.array((long / 2 + 0.9 * above, 0.0, level))
    if rng.random() < 0.6:
        solids += nozzle(rng, end, np.array((1.0, 0, 0)), 0.06, 0.18)
    drain, down = np.array((-0.2 * long, 0.0, level - radius)), np.array((0, 0, -1.0))
    solids += nozzle(rng, drain, down, 0.035, min(0.1, 0.6 * (level - radius)))
    if rng.random() < 0.35:
        solids += _catwalk(rng, radius, long, level)
    return solids


def _catwalk(rng: Rng, radius: float, long: float, level: float) -> list[Manifold]:
    """A plank along the top of a lying vessel, with a rail and a ladder to it."""
    y, high = -0.45 * radius, level + radius + 0.06
    solids = [box((0, y, high), (0.9 * long, 0.3, 0.03))]
    for x in np.linspace(-0.42, 0.42, 4) * long:
        solids.append(
            box((x, y, level + 0.9 * radius), (0.05, 0.1, 0.3 * radius + 0.1))
        )
        post = np.array((x, y - 0.13, high))
        solids.append(rod(post, post + (0, 0, 0.5), 0.015, segments=8))
    for lift in (0.27, 0.5):
        ends = (
            (-0.42 * long, y - 0.13, high + lift),
            (0.42 * long, y - 0.13, high + lift),
        )
        solids.append(rod(*ends, 0.015, segments=8))
    x = rng.choice([-0.3, 0.3]) * long
    for side in (-0.16, 0.16):
        foot = np.array((x + side, -1.12 * radius, 0.0))
        solids.append(rod(foot, foot + (0, 0, high), 0.017, segments=8))
        solids.append(rod(foot + (0, 0, high), (x + side, y, high), 0.017, segments=8))
    for rung in np.arange(0.2, high, 0.27):
        ends = (x - 0.16, -1.12 * radius, rung), (x + 0.16, -1.12 * radius, rung)
        solids.append(rod(*ends, 0.013, segments=8))
    return solids


def _caged(rng: Rng) -> list[Manifold]:
    """A cubic container with rounded edges in a cage of pipes on a pallet."""
    half_x, half_y = rng.uniform(0.48, 0.62), rng.uniform(0.48, 0.55)
    tall, low = rng.uniform(0.75, 1.05), 0.15
    solids = [box((0, 0, low + tall / 2), (1.9 * half_x, 1.9 * half_y, tall), 0.06)]
    neck = (0, 0, low + tall)
    solids.append(rod(neck, np.add(neck, (0, 0, 0.05)), 0.13, segments=24))
    cap = rod(np.add(neck, (0, 0, 0.02)), np.add(neck, (0, 0, 0.07)), 0.11, segments=12)
    solids.append(cap)
    pipe, high = 0.012, low + 0.97 * tall
    columns, rows = int(rng.integers(4, 7)), int(rng.integers(3, 6))
    for level in np.linspace(low + 0.08, high, rows):
        for side in (-1, 1):
            y, x = side * half_y, side * half_x
            solids.append(
                rod((-half_x, y, level), (half_x, y, level), pipe, segments=6)
            )
            solids.append(
                rod((x, -half_y, level), (x, half_y, level), pipe, segments=6)
            )
    for share in np.linspace(-1, 1, columns):
        for side in (-1, 1):
            spots = (share * half_x, side * half_y), (side * half_x, share * half_y)
            for x, y in spots:
                solids.append(rod((x, y, low - 0.02), (x, y, high), pipe, segments=6))
    solids.append(box((0, 0, low), (2 * half_x + 0.06, 2 * half_y + 0.06, 0.035)))
    if rng.random() < 0.5:
        for x in np.linspace(-0.9, 0.9, 3) * half_x:
            solids.append(box((x, 0, 0.0125), (0.12, 2 * half_y, 0.025)))
            for y in np.linspace(-0.9, 0.9, 3) * half_y:
                solids.append(box((x, y, low / 2), (0.12, 0.12, low)))
    else:
        for spot in (*corners(0.92 * half_x, 0.92 * half_y), np.zeros(3)):
            solids.append(bar(spot, spot + (0, 0, low), 0.14, 0.14, 0.7))
    outlet = np.array((0.0, 0.93 * half_y, low + 0.09))
    solids += nozzle(rng, outlet, np.array((0.0, 1.0, 0.0)), 0.04, 0.2)
    solids.append(bar(outlet + (0, 0.1, 0.02), outlet + (0.1, 0.12, 0.09), 0.03, 0.015))
    if rng.random() < 0.6:
        plate = (rng.uniform(-0.3, 0.3) * half_x, half_y, low + 0.55 * tall)
        solids.append(box(plate, (0.4, 0.02, 0.3)))
    return solids
