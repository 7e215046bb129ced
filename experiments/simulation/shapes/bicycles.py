"""Procedural bicycles, riding to the front."""

from typing import NamedTuple

import numpy as np
from manifold3d import CrossSection, Manifold
from scipy.spatial.transform import Rotation

from experiments.simulation.solids import (
    assembled,
    bar,
    box,
    capsule,
    ellipse,
    place,
    ring_of,
    rod,
    sweep,
    torus,
    tube_along,
)

Rng = np.random.Generator


def wheel(rng: Rng, kind: str, radius: float, tyre: float) -> list[Manifold]:
    """Tyre, rim, hub and spokes about z: wires in two planes, wide arms, or a disc."""
    inner = radius - tyre
    solids = [torus(inner, tyre, segments=36, around=8)]
    rim = [(inner - 0.02, -0.6), (inner, -0.8), (inner, 0.8), (inner - 0.02, 0.6)]
    hub = rng.uniform(0.018, 0.03)
    solids += [
        CrossSection([np.array(rim) * (1, tyre)]).revolve(36),
        rod((0, 0, -0.058), (0, 0, 0.058), 0.5 * hub, segments=10),
        rod((0, 0, -0.035), (0, 0, 0.035), hub, segments=16),
    ]
    style = rng.random()
    if style < 0.75:
        count, wire = int(rng.choice([6, 8, 9])), 0.0028
        for side in (-1, 1):
            spoke = rod(
                (0.8 * hub, 0, side * 0.03), ((inner - 0.01), 0, 0), wire, segments=6
            )
            solids += ring_of(spoke, count, 90 * side / count)
    elif style < 0.92 or kind == "town":
        arm = bar((0.5 * hub, 0, 0), (inner - 0.01, 0, 0), 0.018, 0.04, 0.6)
        solids += ring_of(arm, int(rng.integers(3, 7)))
    else:
        solids.append(rod((0, 0, -0.008), (0, 0, 0.008), inner - 0.005, segments=36))
    return solids


def mudguard(axle: np.ndarray, wheel: float, tyre: float, long: bool) -> list[Manifold]:
    """A strip around the upper part of a wheel, held by two stays."""
    first, last = (0.05, 0.9) if long else (0.18, 0.95)
    angle = np.pi * np.linspace(first, last, 14)
    ring = np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    path = axle + (wheel + 0.012) * ring
    strip = np.array([(-1.7, -0.15), (1.7, -0.15), (1.7, 0.15), (-1.7, 0.15)])
    solids = [sweep(path, tyre * strip)]
    for x in (-1.5 * tyre, 1.5 * tyre):
        end, start = path[-2] + (x, 0, 0), axle + (np.sign(x) * 0.056, 0, 0)
        solids.append(rod(start, end, 0.004, segments=6))
    upper = path[7]
    return [*solids, rod(upper, upper + (0, 0, 0.03), 0.008, segments=8)]


def chain_drive(rng: Rng, bracket: np.ndarray, rear: np.ndarray) -> list[Manifold]:
    """Chain wheel, sprocket, chain or its case, cranks and pedals."""
    side, ring = np.array((0.05, 0, 0)), rng.uniform(0.06, 0.095)
    across = np.array((0.008, 0, 0))
    center, small = bracket + side, rear + side
    solids = [rod(center - across, center + across, ring, segments=28)]
    solids.append(rod(small - across, small + across, 0.42 * ring, segments=20))
    chain = [
        rod(point - across / 2, point + across / 2, size, segments=24)
        for point, size in ((center, 1.05 * ring), (small, 0.5 * ring))
    ]
    case = Manifold.batch_hull(chain)
    if rng.random() < 0.65:
        hole = [
            rod(point - side, point + side, size, segments=20)
            for point, size in ((center, 0.93 * ring), (small, 0.38 * ring))
        ]
        case -= Manifold.batch_hull(hole)
    solids += [case, rod(bracket - 1.4 * side, bracket + 1.4 * side, 0.014)]
    angle, long = rng.uniform(0, 2 * np.pi), 1.9 * ring
    crank = long * np.array((0.0, np.cos(angle), np.sin(angle)))
    crank[2] = max(crank[2], 0.05 - bracket[2]) if crank[2] < 0 else crank[2]
    for sign in (-1, 1):
        root = bracket + sign * 1.3 * side
        tip = root + sign * crank
        solids.append(capsule(root, tip, 0.013, 0.01, 10))
        solids.append(box(tip + (sign * 0.055, 0, 0), (0.1, 0.08, 0.025)))
    return solids


def carrier(
    rng: Rng, rear: np.ndarray, radius: float, seat: np.ndarray
) -> list[Manifold]:
    """Rods over the wheel about `rear`, held at its axle and at the seat tube."""
    long, solids = rng.uniform(0.32, 0.42), []
    middle = np.array((0.0, rear[1] - 0.04, rear[2] + radius + 0.05))
    for x in (-0.055, 0.0, 0.055):
        start = middle + (x, -long / 2, 0)
        solids.append(rod(start, start + (0, long, 0), 0.007, segments=8))
    for y in np.linspace(-0.48, 0.48, 4) * long:
        start = middle + (-0.055, y, 0)
        solids.append(rod(start, start + (0.11, 0, 0), 0.006, segments=8))
    for x in (-0.055, 0.055):
        foot, front = rear + (1.15 * x, 0, 0), middle + (x, long / 2, 0)
        solids.append(rod(foot, middle + (x, -0.1, 0), 0.007, segments=8))
        solids.append(rod(seat + (0.2 * x, 0, -0.05), front, 0.007, segments=8))
    return solids


ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Takes z to x: wheels turn about x."""


class Geometry(NamedTuple):
    """Points of the frame in the plane x = 0, and the wheels' radius."""

    rear: np.ndarray
    front: np.ndarray
    bracket: np.ndarray
    seat: np.ndarray
    saddle: np.ndarray
    head_low: np.ndarray
    head_high: np.ndarray
    wheel: float


def bicycle(rng: Rng) -> list[Manifold]:
    """Road, town, mountain, folding and children's bicycles, and cargo ones with a box;
    with carriers, baskets, mudguards and stands."""
    kinds = ["road", "town", "mountain", "folding", "child", "cargo"]
    kind = str(rng.choice(kinds, p=[0.2, 0.24, 0.2, 0.14, 0.12, 0.1]))
    shape = _geometry(rng, kind)
    tyre = {"road": 0.013, "mountain": 0.028, "child": 0.024}.get(kind, 0.019)
    pipe = rng.uniform(0.013, 0.019) * (1.25 if kind == "mountain" else 1.0)
    solids = [*_frame(rng, kind, shape, pipe), *_saddle(rng, kind, shape, pipe)]
    parts = wheel(rng, kind, shape.wheel, tyre)
    solids += [place(part, ALONG_X, shape.rear) for part in parts]
    solids += chain_drive(rng, shape.bracket, shape.rear)
    steered = [place(part, ALONG_X, shape.front) for part in parts]
    steered += [*_fork(rng, shape, pipe), *_handlebar(rng, kind, shape, pipe)]
    if kind in ("town", "folding", "child"):
        solids += mudguard(shape.rear, shape.wheel, tyre, True)
        steered += mudguard(shape.front, shape.wheel, tyre, False)
    solids += _steered(steered, shape, rng.normal() * 10)
    return assembled(solids + _extras(rng, kind, shape))


def _geometry(rng: Rng, kind: str) -> Geometry:
    """Wheelbase, angles and heights by the kind."""
    wheel = {"folding": 0.22, "child": 0.19, "cargo": 0.28}.get(kind, 0.34)
    wheel *= rng.uniform(0.92, 1.06)
    size = 0.62 if kind == "child" else rng.uniform(0.92, 1.08)
    base = {"cargo": 1.75, "folding": 1.0, "child": 0.95}.get(kind, 1.02)
    base *= rng.uniform(0.95, 1.05) * (0.85 if kind == "child" else 1.0)
    bracket = np.array((0.0, 0.0, wheel * (0.85 if wheel > 0.25 else 1.2)))
    rear = np.array((0.0, -rng.uniform(0.41, 0.46) * min(size + 0.05, 1), wheel))
    front = np.array((0.0, rear[1] + base, wheel))
    lean = np.radians(rng.uniform(68, 75))
    along = np.array((0.0, -np.cos(lean), np.sin(lean)))
    tall = rng.uniform(0.42, 0.56) * size
    if kind in ("folding", "mountain"):
        tall *= 0.8
    seat = bracket + tall * along
    saddle = bracket + size * rng.uniform(0.6, 0.74) * along
    steer = np.radians(rng.uniform(67, 74))
    axis = np.array((0.0, -np.cos(steer), np.sin(steer)))
    low = front + axis * (wheel * 1.18 + 0.06) - (0, 0.045, 0)
    high_z = max(bracket[2] + rng.uniform(0.5, 0.58) * size, low[2] + 0.1)
    high = low + axis * (high_z - low[2]) / axis[2]
    return Geometry(rear, front, bracket, seat, saddle, low, high, wheel)


def _frame(rng: Rng, kind: str, shape: Geometry, pipe: float) -> list[Manifold]:
    """Diamond, low step-through, or a single beam; stays on both sides behind."""
    rear, bracket, seat = shape.rear, shape.bracket, shape.seat
    low, high = shape.head_low, shape.head_high
    solids = [
        rod(low - 0.1 * (high - low), high + 0.1 * (high - low), 1.3 * pipe),
        rod(bracket, seat, pipe, segments=14),
        rod(bracket - (0.045, 0, 0), bracket + (0.045, 0, 0), 1.5 * pipe),
    ]
    share = rng.uniform(0.1, 0.4)
    join = low + share * (high - low)
    if kind in ("folding", "child", "cargo") or (kind == "town" and share < 0.2):
        thick, knee = 1.7 * pipe, bracket + (0, 0.08, 0.03)
        if kind == "cargo":
            knee = np.array((0.0, shape.front[1] - 1.3 * shape.wheel, bracket[2]))
            join = low + 0.5 * (high - low)
        solids += tube_along(np.array([bracket, knee, join]), thick, 12)
        solids.append(rod(bracket + 0.4 * (seat - bracket), knee, pipe))
    else:
        top = high - 0.1 * (high - low)
        solids.append(rod(bracket, join, 1.15 * pipe, segments=14))
        end = seat - 0.06 * (seat - bracket)
        if kind == "town":
            end = bracket + rng.uniform(0.35, 0.6) * (seat - bracket)
            top = join + 0.35 * (high - join)
        solids.append(rod(end, top, pipe, segments=14))
    for x in (-0.06, 0.06):
        hub = rear + (x, 0, 0)
        solids.append(rod(hub, bracket + (0.5 * x, -0.01, 0), 0.6 * pipe, segments=10))
        solids.append(rod(hub, seat + (0.3 * x, 0, -0.02), 0.5 * pipe, segments=10))
    return solids


def _saddle(rng: Rng, kind: str, shape: Geometry, pipe: float) -> list[Manifold]:
    wide, long = rng.uniform(0.065, 0.1), rng.uniform(0.24, 0.28)
    if kind == "child":
        wide, long = 0.07, 0.2
    point = shape.saddle
    sections = [
        ellipse(point + (0, -0.45 * long, 0), (wide, 0.03), 14),
        ellipse(point + (0, -0.15 * long, 0), (0.8 * wide, 0.028), 14),
        ellipse(point + (0, 0.55 * long, -0.005), (0.024, 0.018), 14),
    ]
    return [
        Manifold.hull_points(np.concatenate(sections)),
        rod(shape.seat - 0.1 * (shape.seat - shape.bracket), point, 0.8 * pipe),
        rod(shape.seat - (0, 0, 0.02), shape.seat + (0, 0, 0.015), 1.4 * pipe),
    ]


def _fork(rng: Rng, shape: Geometry, pipe: float) -> list[Manifold]:
    """Two blades from the crown to the axle, and the steerer up to the bar."""
    crown, half = shape.head_low, 0.055
    solids = [rod(crown - (half, 0, 0), crown + (half, 0, 0), 1.1 * pipe)]
    for x in (-half, half):
        axle = shape.front + (x, 0, 0)
        solids.append(rod(crown + (x, 0, 0), axle, 0.85 * pipe, 0.6 * pipe, 12))
    return [*solids, rod(crown, shape.head_high + (0, 0, 0.0), pipe)]


def _handlebar(rng: Rng, kind: str, shape: Geometry, pipe: float) -> list[Manifold]:
    """A stem, and a bar that is straight, risen, swept back or dropped."""
    axis = (shape.head_high - shape.head_low) / np.linalg.norm(
        shape.head_high - shape.head_low
    )
    rise = 0.04 if kind == "road" else rng.uniform(0.05, 0.16)
    if kind in ("folding", "cargo"):
        rise = rng.uniform(0.25, 0.4)
    neck = shape.head_high + rise * axis
    clamp = neck + (0, rng.uniform(0.04, 0.1), 0.02)
    solids = tube_along(
        np.array([shape.head_high - 0.02 * axis, neck, clamp]), pipe, 10
    )
    half = rng.uniform(0.2, 0.23) if kind == "road" else rng.uniform(0.26, 0.36)
    if kind == "child":
        half = 0.24
    if kind == "road":
        bends = [(0.9, 0, 0), (1, 0.05, 0), (1, 0.1, -0.03), (1, 0.09, -0.11)]
        bends.append((1, -0.03, -0.13))
    elif kind == "mountain":
        bends = [(0.2, 0, 0), (0.35, 0, 0.03), (1, -0.03, 0.03)]
    else:
        bends = [(0.3, 0.03, 0.02), (0.8, 0, 0.05), (1, -rng.uniform(0.08, 0.22), 0.03)]
    right = np.array([(half * x, y, z) for x, y, z in bends])
    points = clamp + np.concatenate([right[::-1] * (-1, 1, 1), [(0, 0, 0)], right])
    solids += tube_along(points, 0.8 * pipe, 10)
    for side in (0, -1):
        inner = points[side] + 0.55 * (points[1 if side == 0 else -2] - points[side])
        solids.append(rod(points[side], inner, 1.15 * pipe, segments=12))
    if rng.random() < 0.4:
        lamp = shape.head_high + (0, 0.05, -0.02)
        solids.append(rod(lamp - (0, 0.06, 0), lamp + (0, 0.05, 0), 0.025, 0.035, 16))
    return solids


def _steered(parts: list[Manifold], shape: Geometry, degrees: float) -> list[Manifold]:
    axis = shape.head_high - shape.head_low
    axis = axis / np.linalg.norm(axis)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    origin = shape.head_low - turn @ shape.head_low
    return [place(part, turn, origin) for part in parts]


def _extras(rng: Rng, kind: str, shape: Geometry) -> list[Manifold]:
    """Carrier, box, training wheels, stand and bottle."""
    solids, rear, bracket = [], shape.rear, shape.bracket
    if kind == "cargo":
        low, tall = bracket[2] + 0.04, rng.uniform(0.28, 0.45)
        y = (bracket[1] + 0.35 + shape.front[1] - 1.2 * shape.wheel) / 2
        tub = box((0, y, low + tall / 2), (0.5, 0.62, tall), 0.02)
        solids.append(tub - box((0, y, low + tall), (0.46, 0.58, 2 * tall - 0.06)))
    if kind in ("town", "folding", "cargo") and rng.random() < 0.75:
        solids += carrier(rng, rear, shape.wheel, shape.seat)
    if kind == "child":
        for side in (-1, 1):
            hub = np.array((side * 0.17, rear[1], 0.07))
            ends = hub - (0.012, 0, 0), hub + (0.012, 0, 0)
            solids.append(rod(*ends, 0.07, segments=20))
            knee = rear + (side * 0.14, 0, -0.02)
            arm = np.array([rear + (side * 0.05, 0, 0), knee, hub])
            solids += tube_along(arm, 0.01)
    elif rng.random() < 0.5:
        root = bracket + 0.12 * (rear - bracket) - (0.033, 0, 0)
        solids.append(rod(root, (-0.2, root[1] - 0.06, 0.0), 0.009, segments=8))
    if kind in ("road", "mountain") and rng.random() < 0.6:
        along = shape.head_low - bracket
        start, along = bracket + 0.35 * along, along / np.linalg.norm(along)
        start = start + 0.045 * np.array((0, -along[2], along[1]))
        solids.append(rod(start, start + 0.17 * along, 0.034, segments=16))
    return solids
