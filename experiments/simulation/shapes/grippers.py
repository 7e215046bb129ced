"""Procedural grippers, in decimetres.

The tool hangs from its flange, as from an arm: the fingertips touch the floor.
"""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import (
    Rng,
    assembled,
    ball,
    bar,
    box,
    capsule,
    corners,
    lathe,
    ring_of,
    rod,
    tube_along,
)


def gripper(rng: Rng) -> list[Manifold]:
    """Parallel and angular jaws, three-jaw, linkage, vacuum, soft fingers, a hand."""
    kinds = {
        "parallel": _parallel,
        "centric": _centric,
        "linkage": _linkage,
        "vacuum": _vacuum,
        "soft": _soft,
        "hand": _hand,
    }
    kind = str(rng.choice(list(kinds), p=[0.26, 0.14, 0.16, 0.2, 0.14, 0.1]))
    return assembled([*_flange(rng), *kinds[kind](rng)])


def _flange(rng: Rng) -> list[Manifold]:
    """Mounting plates from z = 0 up, and a camera beside them in some."""
    level, solids = -0.05, []
    for _ in range(int(rng.integers(1, 4))):
        radius, tall = rng.uniform(0.28, 0.42), rng.uniform(0.08, 0.2)
        solids.append(rod((0, 0, level), (0, 0, level + tall), radius, segments=28))
        level += 0.96 * tall
    holes = rod((0.24, 0, level - 0.06), (0.24, 0, level + 1), 0.03, segments=8)
    for hole in ring_of(holes, 6):
        solids[-1] -= hole
    if rng.random() < 0.3:
        solids.append(box((0, 0.4, 0.0), (0.3, 0.5, 0.05)))
        solids.append(box((0, 0.6, -0.05), (0.45, 0.16, 0.2), 0.03))
        solids.append(rod((0, 0.6, -0.2), (0, 0.6, 0.0), 0.06, segments=14))
    elif rng.random() < 0.35:
        plug = (0.25, 0, 0.02)
        solids.append(rod(plug, np.add(plug, (0.35, 0, 0)), 0.06, segments=12))
    return solids


def _parallel(rng: Rng) -> list[Manifold]:
    wide, deep = rng.uniform(0.8, 1.5), rng.uniform(0.4, 0.7)
    tall = rng.uniform(0.5, 1.0)
    solids = [box((0, 0, -tall / 2), (wide, deep, tall), 0.04)]
    if rng.random() < 0.4:
        level = -0.6 * tall
        drum = (-wide / 2, 0, level), (wide / 2 + 0.3, 0, level)
        solids.append(rod(*drum, 0.3 * deep))
    solids.append(box((0, 0, -tall - 0.03), (1.15 * wide, 0.55 * deep, 0.14)))
    gap, thick = rng.uniform(0.08, 0.42) * wide, rng.uniform(0.1, 0.2)
    jaw = _jaw(rng, thick, deep)
    carriage = box((0.5 * thick, 0, -0.06), (2 * thick + 0.06, 0.7 * deep, 0.2), 0.015)
    for part in (*jaw, carriage):
        right = part.translate((gap + thick / 2, 0, -tall - 0.05))
        solids += [right, right.mirror((1, 0, 0))]
    return solids


def _jaw(rng: Rng, thick: float, deep: float) -> list[Manifold]:
    """A finger down from the origin that closes towards -x: straight, stepped, tapered
    or forked, with a pad in some."""
    long, broad = rng.uniform(0.5, 1.2), rng.uniform(0.3, 0.9) * deep
    style = rng.choice(["straight", "stepped", "taper", "fork"])
    if style == "taper":
        root, slim = (0.3 * thick, 0, 0), rng.uniform(0.4, 0.7)
        return [bar(root, (0, 0, -long), 1.6 * thick, broad, slim)]
    if style == "fork":
        size = (thick, 0.25 * deep, long)
        tines = [box((0, s * 0.4 * deep, -long / 2), size) for s in (-1, 1)]
        return [*tines, box((0, 0, -0.1), (thick, deep, 0.2))]
    if style == "straight":
        solids = [box((0, 0, -long / 2), (thick, broad, long))]
    else:
        out, level = rng.uniform(0.1, 0.35), -0.6 * long
        solids = [
            box((out / 2, 0, -0.06), (out + thick, 0.6 * deep, 0.14)),
            box((out, 0, level / 2), (thick, broad, -level)),
            box((out / 2, 0, level), (out + thick, broad, thick)),
            box((0, 0, level - 0.2 * long), (thick, broad, 0.4 * long)),
        ]
    if rng.random() < 0.6:
        size = (0.08, 1.15 * broad, 0.28 * long)
        solids.append(box((-0.5 * thick, 0, -0.85 * long), size, 0.01))
    return solids


def _centric(rng: Rng) -> list[Manifold]:
    """Three or four jaws that slide on the face of a drum."""
    radius, tall = rng.uniform(0.5, 0.75), rng.uniform(0.4, 0.8)
    profile = [
        (0.9 * radius, -tall),
        (radius, -0.9 * tall),
        (radius, -0.3 * tall),
        (0.6 * radius, 0),
    ]
    solids, jaws = [lathe(profile, 36)], int(rng.choice([2, 3, 3, 4]))
    open_at, long = rng.uniform(0.15, 0.6) * radius, rng.uniform(0.4, 0.9)
    style = rng.choice(["block", "pin", "hook"])
    finger = [box((open_at + 0.2, 0, -tall - 0.05), (0.5, 0.3, 0.22), 0.02)]
    if style == "block":
        finger.append(box((open_at + 0.1, 0, -tall - long / 2), (0.2, 0.26, long)))
    elif style == "pin":
        finger.append(
            rod((open_at + 0.1, 0, -tall), (open_at + 0.1, 0, -tall - long), 0.1)
        )
    else:
        out = (open_at + 0.35, 0, -tall - 0.7 * long)
        finger.append(bar((open_at + 0.35, 0, -tall), out, 0.16, 0.24))
        finger.append(bar(out, (open_at, 0, -tall - long), 0.16, 0.24, 0.6))
    for part in finger:
        solids += ring_of(part, jaws, 90.0)
    if rng.random() < 0.5:
        solids.append(rod((0, 0, -tall - 0.12), (0, 0, -0.9 * tall), 0.25 * radius))
    return solids


def _linkage(rng: Rng) -> list[Manifold]:
    """Two or three fingers of links on pins: four-bar jaws that fold."""
    wide, deep, tall = map(rng.uniform, (0.5, 0.4, 0.6), (0.8, 0.6, 1.0))
    solids = [bar((0, 0, 0), (0, 0, -tall), wide, deep, rng.uniform(0.8, 1.2))]
    solids.append(box((0, 0, -tall), (wide * 1.2, deep * 0.9, 0.2), 0.03))
    opened, long = rng.uniform(-0.15, 0.8), rng.uniform(0.45, 0.7)
    thin, tip = 0.1, rng.uniform(0.4, 0.65)
    count = int(rng.choice([2, 2, 3]))

    def polar(angle: float, reach: float) -> np.ndarray:
        return reach * np.array((np.sin(angle), 0.0, -np.cos(angle)))

    root, finger = np.array((0.5 * wide, 0, -tall)), []
    inner, knee = root - (0.28 * wide, 0, 0.12), root + polar(opened + 0.5, long)
    near = inner + polar(opened + 0.5, long)
    solids.append(box((0, 0, -tall - 0.1), (0.5 * wide, 0.5 * deep, 0.2)))
    for y in (-0.3 * deep, 0.3 * deep):
        for start, end in ((root, knee), (inner, near)):
            shift = np.array((0, y, 0))
            finger.append(bar(start + shift, end + shift, 0.13, thin))
    for point in (root, inner, knee, near):
        ends = point - (0, 0.42 * deep, 0), point + (0, 0.42 * deep, 0)
        finger.append(rod(*ends, 0.075, segments=12))
    finger.append(capsule(knee, near, 0.11, segments=12))
    end = knee + polar(opened * 0.3 - 0.15, tip)
    finger.append(bar(knee, end, 0.2, 0.7 * deep, 0.7))
    finger.append(bar(near, end + (-0.1, 0, 0.1), 0.16, 0.6 * deep))
    pad = (knee + end) / 2 + (-0.16, 0, -0.05)
    finger.append(bar(pad, end + (-0.1, 0, 0), 0.08, 0.75 * deep))
    for part in finger:
        solids += ring_of(part, count)
    return solids


def _vacuum(rng: Rng) -> list[Manifold]:
    """One to twelve cups with bellows under a plate, a cross or a bar."""
    style = str(rng.choice(["single", "plate", "bar", "cross"]))
    size, stem = rng.uniform(0.13, 0.24), rng.uniform(0.25, 0.6)
    solids, tall = [], rng.uniform(0.15, 0.3)
    solids.append(rod((0, 0, -tall), (0, 0, 0), 0.22))
    if style == "single":
        size *= 2.2
        spots = [np.zeros(3)]
        solids.append(box((0, 0, -tall / 2), (0.6, 0.5, tall), 0.04))
    elif style == "bar":
        reach, count = rng.uniform(0.8, 1.6), int(rng.integers(2, 6))
        spots = [np.array((x, 0, 0)) for x in np.linspace(-reach, reach, count)]
        solids.append(box((0, 0, -tall), (2 * reach + 0.3, 0.26, 0.18)))
    elif style == "cross":
        reach = rng.uniform(0.6, 1.1)
        spots = corners(reach, reach * rng.choice([0.6, 1.0]))
        for spot in spots:
            level = np.array((0, 0, -tall))
            solids.append(bar(level, spot * 1.08 + level, 0.14, 0.14))
        if rng.random() < 0.5:
            spots.append(np.zeros(3))
    else:
        x, y = rng.uniform(0.6, 1.2), rng.uniform(0.4, 0.8)
        columns, rows = int(rng.integers(2, 5)), int(rng.integers(2, 4))
        spots = [
            np.array((px, py, 0))
            for px in np.linspace(-x, x, columns)
            for py in np.linspace(-y, y, rows)
        ]
        solids.append(box((0, 0, -tall), (2 * x + 0.4, 2 * y + 0.4, 0.12), 0.02))
    folds = int(rng.integers(1, 4))
    profile, level = [(1.0, 0.0), (0.95, 0.12), (0.5, 0.5)], 0.5
    for _ in range(folds - 1):
        profile += [(0.85, level + 0.18), (0.5, level + 0.36)]
        level += 0.36
    cup = lathe([(size * r, size * z) for r, z in [*profile, (0.3, level + 0.2)]], 20)
    for spot in spots:
        head = spot - (0, 0, tall + stem)
        solids.append(cup.translate(head - (0, 0, size * level)))
        solids.append(rod(head, head + (0, 0, stem + 0.02), 0.28 * size, segments=12))
        nut = head + (0, 0, stem - 0.16)
        solids.append(rod(nut, nut + (0, 0, 0.1), 0.5 * size, segments=6))
    return solids


def _soft(rng: Rng) -> list[Manifold]:
    """Two to six curling fingers with ribs."""
    count, tall = int(rng.integers(2, 7)), rng.uniform(0.2, 0.5)
    radius, curl = rng.uniform(0.4, 0.65), rng.uniform(-0.5, 1.3)
    solids = [rod((0, 0, -tall), (0, 0, 0), 0.9 * radius, 0.35, 28)]
    solids.append(
        rod((0, 0, -tall - 0.08), (0, 0, -tall + 0.02), radius * 1.15, segments=28)
    )
    if count == 2:
        solids = [solids[0], box((0, 0, -tall), (2.5 * radius, 0.5, 0.2), 0.04)]
    long, ribs = rng.uniform(1.0, 1.5), int(rng.integers(5, 9))
    step, point = long / ribs, np.array((radius, 0.0, -tall))
    wide, thick, angle = rng.uniform(0.2, 0.3), 0.2, rng.uniform(0.0, 0.4)
    finger = []
    for k in range(ribs):
        along = np.array((np.sin(angle), 0, -np.cos(angle)))
        out = np.array((np.cos(angle), 0, np.sin(angle)))
        shrink, nxt = 1 - 0.4 * k / ribs, point + step * along
        finger.append(
            bar(point - 0.03 * along, nxt + 0.03 * along, thick * 0.5, wide * shrink)
        )
        low, high = point + 0.15 * step * along, point + 0.75 * step * along
        shift = 0.6 * thick * shrink * out
        finger.append(
            bar(low + shift, high + shift, thick * 1.3 * shrink, wide * shrink)
        )
        point, angle = nxt, angle - curl / ribs
    for part in finger:
        solids += ring_of(part, count)
    return solids


def _hand(rng: Rng) -> list[Manifold]:
    """A palm with three or four jointed fingers and a thumb."""
    fingers, wide = int(rng.integers(3, 5)), rng.uniform(0.9, 1.2)
    palm = rng.uniform(0.8, 1.1)
    near = box((0, 0, -0.1), (0.6 * wide, 0.3, 0.2), 0.05)
    solids = [Manifold.batch_hull([near, box((0, 0, -palm), (wide, 0.34, 0.16), 0.05)])]
    bend, radius = rng.uniform(0.05, 0.7), 0.34 * wide / fingers
    for k in range(fingers):
        x = ((k + 0.5) / fingers - 0.5) * wide * 0.96
        long = 1.0 - 0.15 * abs(k - (fingers - 1) / 2)
        solids += _digit(np.array((x, 0, -palm)), bend, 0.42 * long, radius)
    thumb = _digit(np.array((0.0, 0, 0)), bend * 0.7, 0.36, 1.1 * radius)[:-1]
    turned = [part.rotate((35, 0, 0)).rotate((0, 0, 75)) for part in thumb]
    solids += [part.translate((0.45 * wide, 0.12, -0.5 * palm)) for part in turned]
    return [*solids, ball((0.42 * wide, 0.1, -0.5 * palm), 1.5 * radius, 14)]


def _digit(root: np.ndarray, bend: float, step: float, radius: float) -> list[Manifold]:
    """Three phalanges with pins, each bent further towards +y."""
    points, angle = [root], 0.3 * bend
    for _ in range(3):
        angle += bend
        points.append(points[-1] + step * np.array((0, np.sin(angle), -np.cos(angle))))
        step *= 0.8
    solids = tube_along(np.array(points), 0.85 * radius, 12)
    for point in points[:-1]:
        ends = point - (1.15 * radius, 0, 0), point + (1.15 * radius, 0, 0)
        solids.append(rod(*ends, radius, segments=14))
    return solids
