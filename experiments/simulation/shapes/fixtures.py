"""Procedural workholding fixtures. The unit is about half a metre."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import (
    Rng,
    assembled,
    box,
    corners,
    one_of,
    rod,
    side_profile,
    torus,
    tube,
    union,
)


def fixture(rng: Rng) -> list[Manifold]:
    """What holds a workpiece: a drilled plate with clamps and stops, a vice, an angle
    plate, a tombstone, a three-jaw chuck."""
    makers = _clamping_plate, _vice, _angle_plate, _tombstone, _chuck
    return assembled(one_of(rng, makers, (0.34, 0.2, 0.16, 0.14, 0.16)))


def _base_plate(rng: Rng, width: float, depth: float, thick: float) -> Manifold:
    """Plate from z = 0 down, with a grid of holes, with T-slots, or plain."""
    plate = box((0, 0, -thick / 2), (width, depth, thick), 0.006)
    style = rng.choice(["holes", "slots", "plain"], p=[0.5, 0.3, 0.2])
    if style == "holes":
        counts = rng.integers(4, 8, 2)
        holes = [
            rod((x, y, -0.6 * thick), (x, y, 1), 0.014, segments=8)
            for x in np.linspace(-0.44, 0.44, counts[0]) * width
            for y in np.linspace(-0.42, 0.42, counts[1]) * depth
        ]
        return plate - union(holes)
    if style == "slots":
        cuts = []
        for y in np.linspace(-0.38, 0.38, int(rng.integers(3, 6))) * depth:
            cuts.append(box((0, y, 0), (2, 0.025, thick)))
            cuts.append(box((0, y, -0.45 * thick), (2, 0.05, 0.3 * thick)))
        return plate - union(cuts)
    return plate


def _clamping_plate(rng: Rng) -> list[Manifold]:
    """A plate, a workpiece on rests, and clamps or stops on its four sides."""
    width, depth = rng.uniform(0.8, 1.2), rng.uniform(0.55, 0.85)
    size = np.array((width * rng.uniform(0.3, 0.5), depth * rng.uniform(0.3, 0.45)))
    lift = rng.uniform(0.03, 0.08)
    part, size, top = _workpiece(rng, size, lift, rng.uniform(0.06, 0.18))
    solids = [_base_plate(rng, width, depth, rng.uniform(0.06, 0.1)), *part]
    for foot in corners(0.4 * size[0], 0.4 * size[1]):
        solids.append(rod(foot - (0, 0, 0.01), foot + (0, 0, lift + 0.01), 0.03))
    clamped = rng.permutation(4)[: int(rng.integers(1, 5))]
    kind = str(rng.choice(["toggle", "strap", "swing"]))
    stop = rod((0.035, 0, -0.01), (0.035, 0, 0.4 * lift + 0.6 * top), 0.03)
    for turn in range(4):
        reach, wide = size[turn % 2] / 2, size[1 - turn % 2]
        if turn in clamped:
            pieces = _clamp(rng, kind, reach, top)
        else:
            pieces = [stop.translate((reach, s * wide, 0)) for s in (-0.12, 0.12)]
        solids += [piece.rotate((0, 0, 90 * turn)) for piece in pieces]
    return solids


def _workpiece(
    rng: Rng, size: np.ndarray, lift: float, tall: float
) -> tuple[list[Manifold], np.ndarray, float]:
    """Something within `size` from the height `lift` on; what it measures along x and
    y, and the height of its top."""
    long, wide = size
    part, low = rng.choice(["block", "step", "ring", "tube"]), lift + tall / 2
    if part == "block":
        block = box((0, 0, low), (long, wide, tall), rng.uniform(0, 0.03))
        return [block], size, lift + tall
    if part == "step":
        block = box((0, 0, low), (long, wide, tall))
        upper = (0.5 * long, 0.7 * wide, tall)
        return [block, box((0.1 * long, 0, low + 0.5 * tall), upper)], size, lift + tall
    if part == "ring":
        radius = min(0.6 * long, 0.85 * wide)
        section = tube((0, 0, lift), (0, 0, lift + tall), radius, 0.6 * radius, 32)
        return [section], np.full(2, 2 * radius), lift + tall
    radius = 0.5 * wide
    axis = lift + radius
    ends = (-0.6 * long, 0, axis), (0.6 * long, 0, axis)
    solids = [tube(*ends, radius, 0.7 * radius, 24)]
    vee = [(-0.6 * wide, -0.01), (0.6 * wide, -0.01), (0.6 * wide, axis)]
    vee += [(0.0, lift - 0.2 * radius), (-0.6 * wide, axis)]
    for x in (-0.35 * long, 0.35 * long):
        solids.append(side_profile(np.array(vee), 0.07).translate((x, 0, 0)))
    return solids, size * (1.2, 1.0), lift + 2 * radius


def _clamp(rng: Rng, kind: str, reach: float, top: float) -> list[Manifold]:
    """A clamp from +x on what ends at x = `reach` and at the height `top`."""
    x = reach + rng.uniform(0.08, 0.12)
    if kind == "strap":
        heel = [box((x + 0.1, 0, top / 2), (0.05, 0.07, top + 0.03))]
        strap = box((x, 0, top + 0.018), (0.32, 0.08, 0.04), 0.006)
        stud = rod((x, 0, -0.01), (x, 0, top + 0.11), 0.016, segments=10)
        nut = rod((x, 0, top + 0.03), (x, 0, top + 0.07), 0.035, segments=6)
        return [*heel, strap, stud, nut]
    if kind == "swing":
        body = rod((x, 0, -0.01), (x, 0, 0.75 * top), 0.055, segments=20)
        piston = rod((x, 0, 0), (x, 0, top + 0.06), 0.028, segments=14)
        arm = box((x - 0.07, 0, top + 0.045), (0.2, 0.06, 0.04), 0.006)
        pad = rod((x - 0.15, 0, top - 0.005), (x - 0.15, 0, top + 0.06), 0.016)
        return [body, piston, arm, pad]
    foot = box((x + 0.06, 0, 0.012), (0.15, 0.12, 0.03))
    plates = [
        box((x + 0.06, s, 0.5 * top + 0.03), (0.08, 0.012, top + 0.07))
        for s in (-0.03, 0.03)
    ]
    pivot = np.array((x + 0.06, 0, top + 0.045))
    arm = box(pivot - (0.1, 0, 0), (0.26, 0.05, 0.03))
    screw = rod(pivot - (0.2, 0, 0.05), pivot - (0.2, 0, -0.05), 0.014, segments=8)
    lean = rng.uniform(0.2, 1.3)
    tip = pivot + 0.26 * np.array((np.cos(lean), 0, np.sin(lean)))
    grip = pivot + 0.5 * (tip - pivot)
    lever = [rod(pivot, tip, 0.013, segments=8), rod(grip, tip, 0.024, segments=12)]
    pin = rod(pivot - (0, 0.045, 0), pivot + (0, 0.045, 0), 0.016, segments=10)
    return [foot, *plates, arm, screw, pin, *lever]


def _vice(rng: Rng) -> list[Manifold]:
    """A machine vice: bed, fixed and moving jaw, screw with handle or crank."""
    long, wide = rng.uniform(0.7, 1.0), rng.uniform(0.28, 0.4)
    bed, jaw = rng.uniform(0.1, 0.16), rng.uniform(0.12, 0.2)
    solids = [box((0, 0, bed / 2), (long, 0.8 * wide, bed), 0.008)]
    solids[0] -= box((0.1, 0, bed), (0.6 * long, 0.3 * wide, 0.7 * bed))
    solids.append(box((0, 0, 0.025), (0.8 * long, 1.3 * wide, 0.05)))
    back, gap = -0.36 * long, rng.uniform(0.08, 0.3)
    top = bed + jaw
    solids.append(box((back, 0, top / 2), (0.17, wide, top), 0.01))
    front = back + 0.085 + gap
    solids.append(box((front + 0.1, 0, bed + jaw / 2), (0.2, wide, jaw + 0.02), 0.015))
    for x in (back + 0.08, front + 0.005):
        solids.append(box((x, 0, top - 0.4 * jaw), (0.03, 1.1 * wide, 0.75 * jaw)))
    end, axis = long / 2 + 0.08, bed + 0.3 * jaw
    solids.append(rod((front, 0, axis), (end, 0, axis), 0.035, segments=14))
    solids.append(box((0.46 * long, 0, axis / 2), (0.08, 0.8 * wide, axis + 0.1), 0.01))
    arm = rng.uniform(0.12, 0.22)
    if rng.random() < 0.5:
        solids.append(rod((end, -arm, axis), (end, arm, axis), 0.014, segments=8))
        solids += [
            rod((end, s - 0.015, axis), (end, s + 0.015, axis), 0.024, segments=10)
            for s in (-arm, arm)
        ]
        solids.append(rod((end - 0.04, 0, axis), (end + 0.03, 0, axis), 0.045))
    else:
        solids.append(box((end, 0.4 * arm, axis), (0.03, arm, 0.05)))
        solids.append(
            rod((end, 0.85 * arm, axis), (end + 0.14, 0.85 * arm, axis), 0.022)
        )
    if rng.random() < 0.6:
        size = (gap, rng.uniform(0.5, 1.4) * wide, rng.uniform(0.3, 0.9) * jaw)
        center = (back + 0.09 + gap / 2, 0, top - 0.1 * jaw)
        solids.append(box(center, np.add(size, (0.02, 0, 0))))
    if rng.random() < 0.5:
        solids.append(rod((0, 0, -0.06), (0, 0, 0.03), 0.62 * wide, segments=36))
    return solids


def _angle_plate(rng: Rng) -> list[Manifold]:
    """Base and upright wall with gussets; a part or stops clamped to the wall."""
    width, depth, tall = map(rng.uniform, (0.5, 0.4, 0.5), (0.9, 0.6, 0.8))
    thick = 0.07
    base = _base_plate(rng, width, depth, thick)
    wall = _base_plate(rng, width, tall, thick).rotate((-90, 0, 0))
    wall = wall.translate((0, -depth / 2 + thick, tall / 2 - thick))
    solids, y = [base, wall], -depth / 2
    corner = [(y, -thick), (y, tall - 0.12), (y - 0.3, 0.0), (y - 0.3, -thick)]
    for x in np.linspace(-0.42, 0.42, int(rng.integers(2, 4))) * width:
        solids.append(side_profile(np.array(corner), 0.05).translate((x, 0, 0)))
    solids.append(box((0, y - 0.1, -thick / 2), (width, 0.4, thick)))
    face, size = y + thick, rng.uniform(0.25, 0.5, 2) * (width, tall)
    center = (0, face + 0.06, 0.5 * tall)
    if rng.random() < 0.5:
        part = box(center, (size[0], 0.14, size[1]), 0.01)
        solids.append(
            part - rod((0, 0, 0.5 * tall), (0, 9, 0.5 * tall), 0.2 * min(size))
        )
    else:
        radius = 0.5 * min(size)
        solids += [
            rod(
                (0, face - 0.01, 0.5 * tall),
                (0, face + 0.16, 0.5 * tall),
                radius,
                segments=28,
            ),
            rod((0, face, 0.5 * tall), (0, face + 0.28, 0.5 * tall), 0.45 * radius),
        ]
        size = np.array((2 * radius, 2 * radius))
    for side in (-1, 1):
        pieces = _clamp(rng, "strap", size[0] / 2, 0.14)
        turned = [
            p.rotate((0, 0, 0 if side > 0 else 180)).rotate((-90, 0, 0)) for p in pieces
        ]
        solids += [p.translate((0, face, 0.5 * tall)) for p in turned]
    return solids


def _tombstone(rng: Rng) -> list[Manifold]:
    """A column of four or six faces with parts on each, on a round or square pallet."""
    sides, tall = int(rng.choice([4, 4, 6])), rng.uniform(0.6, 0.9)
    radius, flat = rng.uniform(0.2, 0.3), 180 / sides
    apothem = radius * np.cos(np.radians(flat))
    solids = [rod((0, 0, 0), (0, 0, tall), radius, segments=sides).rotate((0, 0, flat))]
    if rng.random() < 0.5:
        solids.append(rod((0, 0, -0.08), (0, 0, 0.01), 1.7 * radius, segments=36))
    else:
        solids.append(box((0, 0, -0.035), (3 * radius, 3 * radius, 0.09), 0.02))
    if rng.random() < 0.6:
        eye = torus(0.06, 0.018, segments=16).rotate((90, 0, 0))
        solids.append(eye.translate((0, 0, tall + 0.05)))
    rows, kind = int(rng.integers(2, 5)), rng.choice(["block", "disc", "bracket"])
    half = 0.5 * apothem * np.tan(np.radians(flat)) * 2
    for turn, row in np.ndindex(sides, rows):
        z = (row + 0.6) * tall / (rows + 0.2)
        if kind == "block":
            part = [box((apothem, 0, z), (0.16, 1.2 * half, 0.5 * tall / rows))]
        elif kind == "disc":
            size = min(0.7 * half, 0.36 * tall / rows)
            part = [rod((apothem - 0.02, 0, z), (apothem + 0.09, 0, z), size)]
            part.append(rod((apothem, 0, z), (apothem + 0.16, 0, z), 0.4 * size))
        else:
            part = [box((apothem, 0, z), (0.06, 1.3 * half, 0.12))]
            for s in (-0.5, 0.5):
                part.append(box((apothem + 0.04, s * half, z), (0.12, 0.05, 0.2)))
        solids += [piece.rotate((0, 0, turn * 360 / sides)) for piece in part]
    return solids


def _chuck(rng: Rng) -> list[Manifold]:
    """A jaw chuck lying on a plate, or standing on a bracket; with a part in some."""
    radius, deep = rng.uniform(0.26, 0.36), rng.uniform(0.14, 0.22)
    jaws, open_at = int(rng.choice([3, 3, 4])), rng.uniform(0.15, 0.5) * radius
    body = rod((0, 0, 0), (0, 0, deep), radius, segments=40)
    bore = rod((0, 0, 0.3 * deep), (0, 0, 9), 0.22 * radius)
    steps = [
        box((open_at + 0.3 * radius, 0, deep), (0.6 * radius, 0.2 * radius, 0.14)),
        box(
            (open_at + 0.15 * radius, 0, deep + 0.08),
            (0.3 * radius, 0.2 * radius, 0.16),
        ),
    ]
    solids = [body - bore]
    for k in range(jaws):
        solids += [step.rotate((0, 0, 90 + 360 * k / jaws)) for step in steps]
    if rng.random() < 0.55:
        top = deep + rng.uniform(0.2, 0.5)
        solids.append(rod((0, 0, 0.2 * deep), (0, 0, top), open_at + 0.01, segments=24))
    if rng.random() < 0.5:
        return [*solids, box((0, 0, -0.03), (2.5 * radius, 2.5 * radius, 0.08), 0.01)]
    solids, low = [solid.rotate((-90, 0, 0)) for solid in solids], -1.25 * radius
    solids.append(box((0, -0.05, low / 2), (1.3 * radius, 0.14, -low)))
    solids.append(box((0, 0, low), (2.2 * radius, 0.5, 0.08), 0.01))
    return [*solids, rod((0, -0.2, 0), (0, 0.02, 0), 0.7 * radius, segments=28)]
