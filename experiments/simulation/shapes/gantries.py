"""Procedural gantries."""

import itertools

import numpy as np

from experiments.simulation.shapes.machine_frames import beam
from experiments.simulation.solids import (
    Rng,
    Solids,
    assembled,
    box,
    corners,
    rod,
    side_profile,
    torus,
)


def gantry(rng: Rng) -> Solids:
    """A bridge over a space: portal crane, Cartesian robot on posts, router."""
    kind = rng.choice(["crane", "robot", "router"], p=[0.38, 0.34, 0.28])
    if kind == "crane":
        return assembled(_crane(rng))
    return assembled(_cartesian(rng)) if kind == "robot" else assembled(_router(rng))


def _crane(rng: Rng) -> Solids:
    """One or two girders on A-shaped, straight or lattice legs with wheels; trolley
    and hook."""
    span, tall = rng.uniform(1.8, 3.2), rng.uniform(1.3, 2.2)
    size, base = rng.uniform(0.08, 0.14), rng.uniform(0.7, 1.2)
    over, girders = rng.choice([0.0, 0.3]), int(rng.integers(1, 3))
    rows = [0.0] if girders == 1 else [-0.16, 0.16]
    ends, kind = span / 2 + over, str(rng.choice(["square", "channel"]))
    solids = []
    for y in rows:
        start, end = (-ends, y, tall), (ends, y, tall)
        solids.append(beam(start, end, 1.4 * size, kind))
    style = str(rng.choice(["a", "straight", "wide"]))
    for x in (-span / 2, span / 2):
        foot = 0.12
        solids.append(beam((x, -base / 2, foot), (x, base / 2, foot), size))
        for side in (-1, 1):
            head = 0.08 + 0.16 * (girders - 1) if style != "wide" else 0.3 * base
            low = 0.42 * base if style != "straight" else head
            start = np.array((x, side * low, foot))
            solids.append(beam(start, (x, side * head, tall), size * 0.8))
            wheel = (x, side * 0.42 * base, 0.07)
            axle = np.array((0.05, 0, 0))
            solids.append(rod(wheel - axle, wheel + axle, 0.07, segments=16))
            if style == "a" or rng.random() < 0.3:
                knee = start + 0.68 * (np.array((x, side * head, tall)) - start)
                brace = (x - np.sign(x) * 0.3 * tall, side * head * 0.6, tall)
                solids.append(beam(knee, brace, size * 0.4))
        solids.append(beam((x, -0.3 * base, tall), (x, 0.3 * base, tall), size))
        level, reach = 0.45 * tall, 0.6 * low + 0.4 * head
        solids.append(beam((x, -reach, level), (x, reach, level), 0.5 * size))
    x, drop = rng.uniform(-0.3, 0.3) * span, tall * rng.uniform(0.3, 0.7)
    solids.append(box((x, 0, tall + 0.06), (0.3, 0.36 + rows[-1], 0.16), 0.01))
    solids.append(box((x, 0, tall - 0.14), (0.22, 0.2, 0.3), 0.02))
    solids.append(rod((x, 0, tall - 0.1), (x, 0, drop), 0.018, segments=8))
    hook = torus(0.07, 0.02, 250.0, 20).rotate((90, 0, 0)).rotate((0, 0, 180))
    solids.append(box((x, 0, drop), (0.1, 0.06, 0.14), 0.01))
    return [*solids, hook.translate((x, 0, drop - 0.12))]


def _cartesian(rng: Rng) -> Solids:
    """Posts carry two rails along y; the bridge along x carries an upright axis."""
    width, depth = rng.uniform(1.2, 2.2), rng.uniform(1.0, 2.0)
    tall, size = rng.uniform(1.0, 1.6), rng.uniform(0.06, 0.11)
    kind, x, y = str(rng.choice(["square", "profile"])), width / 2, depth / 2
    rows = [-y, y] if depth < 1.5 or rng.random() < 0.5 else [-y, 0, y]
    solids = []
    for side, row in itertools.product((-x, x), rows):
        solids.append(beam((side, row, 0), (side, row, tall), size, kind))
        solids.append(box((side, row, 0.01), (2.4 * size, 2.4 * size, 0.02)))
    for side in (-x, x):
        over = 0.08
        solids.append(
            beam((side, -y - over, tall), (side, y + over, tall), 1.2 * size, kind)
        )
        solids.append(box((side, 0, tall + 0.65 * size), (0.03, depth, 0.04)))
    for row in (-y, y):
        if rng.random() < 0.6:
            solids.append(beam((-x, row, tall), (x, row, tall), size, kind))
        if rng.random() < 0.35:
            low = rng.choice([0.12, 0.5]) * tall
            solids.append(beam((-x, row, low), (x, row, low), 0.7 * size, kind))
    level, bridge = tall + 1.5 * size, rng.uniform(-0.6, 0.6) * y
    for shift in [0.0] if rng.random() < 0.6 else [-0.9 * size, 0.9 * size]:
        start = (-x - 0.1, bridge + shift, level)
        solids.append(beam(start, (x + 0.1, bridge + shift, level), 1.1 * size, kind))
    for side in (-x, x):
        solids.append(box((side, bridge, tall + 0.9 * size), (0.16, 0.3, 0.09), 0.01))
    solids += _upright_axis(rng, rng.uniform(-0.6, 0.6) * x, bridge, level, size, tall)
    if rng.random() < 0.4:
        table = (width * 0.55, depth * 0.6, 0.06)
        solids.append(box((0, 0, tall * 0.35), table))
        for foot in corners(table[0] * 0.45, table[1] * 0.45):
            solids.append(box(foot + (0, 0, tall * 0.17), (0.05, 0.05, tall * 0.36)))
        # Joined to the posts, so that the shape stays in one piece.
        solids += [beam((-x, row, 0.03), (x, row, 0.03), 0.05) for row in (-y, y)]
        for foot in (-table[0] * 0.45, table[0] * 0.45):
            solids.append(beam((foot, -y, 0.03), (foot, y, 0.03), 0.05))
    return solids


def _upright_axis(
    rng: Rng, x: float, y: float, level: float, size: float, tall: float
) -> Solids:
    """A carriage on the bridge, the axis through it, and a tool at its lower end."""
    low, long = level - tall * rng.uniform(0.2, 0.6), tall * rng.uniform(0.5, 0.8)
    front = y + 1.5 * size
    solids = [box((x, y + 0.8 * size, level), (0.22, 1.8 * size, 0.26), 0.012)]
    solids.append(beam((x, front, low), (x, front, low + long), size))
    tool = rng.choice(["gripper", "cup", "spindle"])
    if tool == "gripper":
        solids.append(box((x, front, low), (0.2, 0.1, 0.06)))
        for side in (-0.07, 0.07):
            solids.append(box((x + side, front, low - 0.1), (0.03, 0.06, 0.18)))
    elif tool == "cup":
        solids.append(box((x, front, low), (0.3, 0.2, 0.03)))
        for point in corners(0.11, 0.06):
            foot = point + (x, front, low - 0.1)
            solids.append(rod(foot, foot + (0, 0, 0.1), 0.035, 0.012, 12))
    else:
        head = (x, front, low)
        solids.append(rod((x, front, low - 0.2), head, 0.065, segments=20))
        solids.append(rod((x, front, low - 0.32), head, 0.02, segments=10))
    return solids


def _router(rng: Rng) -> Solids:
    """A bed on a stand; side plates and a beam that travel along it; a spindle."""
    width, depth = rng.uniform(0.7, 1.2), rng.uniform(0.9, 1.6)
    stand, rise = rng.choice([0.0, rng.uniform(0.35, 0.7)]), rng.uniform(0.3, 0.5)
    bed = stand + 0.1
    solids = [box((0, 0, bed - 0.04), (width, depth, 0.08))]
    for x in np.linspace(-0.42, 0.42, 6) * width:
        solids.append(box((x, 0, bed + 0.01), (0.09 * width, depth * 0.96, 0.03)))
    for x in (-width / 2, width / 2):
        solids.append(box((x, 0, bed - 0.06), (0.09, depth * 1.02, 0.14)))
        if stand:
            for y in (-0.44 * depth, 0.44 * depth):
                solids.append(beam((x, y, 0), (x, y, bed), 0.07))
            solids.append(beam((x, -0.44 * depth, 0.1), (x, 0.44 * depth, 0.1), 0.05))
    if stand:
        for y in (-0.44 * depth, 0.44 * depth):
            solids.append(beam((-width / 2, y, 0.1), (width / 2, y, 0.1), 0.05))
    y, foot, head = rng.uniform(-0.3, 0.3) * depth, 0.16, rng.uniform(0.06, 0.12)
    low, high = bed - 0.1, bed + rise
    lean = rng.choice([0.0, -0.12])
    outline = [(y - foot, low), (y + foot, low), (y + head + lean, high)]
    outline.append((y - head + lean, high))
    for x in (-width / 2 - 0.05, width / 2 + 0.05):
        solids.append(side_profile(np.array(outline), 0.04).translate((x, 0, 0)))
    level, size = high - 0.1, rng.uniform(0.1, 0.16)
    solids.append(box((0, y + lean, level), (width + 0.12, 0.1, size)))
    solids.append(box((0, y + lean + 0.055, level), (width, 0.03, size * 0.3)))
    x, front = rng.uniform(-0.3, 0.3) * width, y + lean + 0.1
    solids.append(box((x, front, level + 0.03), (0.2, 0.1, 0.3), 0.01))
    top, tip = (x, front + 0.08, level + 0.22), bed + rng.uniform(0.04, 0.15)
    solids.append(rod((x, front + 0.08, tip + 0.08), top, 0.055, segments=20))
    solids.append(rod((x, front + 0.08, tip), top, 0.018, segments=10))
    return [*solids, rod((x, front, level + 0.1), (x, front, level + 0.3), 0.045)]
