"""Procedural conveyors."""

import itertools

import numpy as np
from manifold3d import Manifold

from experiments.simulation.shapes.drives import motor
from experiments.simulation.solids import Rng, Solids, assembled, bar, box, capsule, rod


def conveyor(rng: Rng) -> Solids:
    """Belt, rollers or slats on a straight, rising, cranked or curved way, on legs;
    with guides, drives and goods in some."""
    width, thick = rng.uniform(0.3, 0.7), rng.uniform(0.06, 0.12)
    way = _way(rng)
    middle, across = way
    points = {s: middle + s * (width / 2) * across for s in (-1, 1)}
    rows = list(itertools.pairwise(range(len(middle))))
    kind = str(rng.choice(["belt", "rollers", "cleats"], p=[0.4, 0.42, 0.18]))
    frame, solids = rng.uniform(0.8, 1.6) * thick, []
    for first, last in rows:
        for side in points.values():
            ends = side[first] - (0, 0, 0.1 * frame), side[last] - (0, 0, 0.1 * frame)
            solids.append(bar(*ends, 0.035, frame))
        if kind != "rollers":
            corner = [points[s][k] for s in (-1, 1) for k in (first, last)]
            slab = [p + (0, 0, z) for p in corner for z in (-0.5 * thick, 0.5 * thick)]
            solids.append(Manifold.hull_points(np.array(slab)))
    pitch = rng.uniform(0.09, 0.16) if kind == "rollers" else 0.3
    for place, axis in zip(*_stations(way, pitch), strict=True):
        half = (width / 2 + 0.012) * axis
        if kind == "rollers":
            solids.append(rod(place - half, place + half, 0.4 * pitch, segments=10))
        elif kind == "cleats":
            top = place + (0, 0, 0.5 * thick)
            solids.append(bar(top - 0.95 * half, top + 0.95 * half, 0.02, 0.09))
    for k in (0, -1):
        half = (width / 2 + 0.01) * across[k]
        ends = middle[k] - half, middle[k] + half
        solids.append(rod(*ends, 0.5 * thick, segments=16))
    solids += _legs(rng, way, width, thick)
    if rng.random() < 0.4:
        solids += _guides(points, thick)
    if rng.random() < 0.5:
        solids += _drive(rng, points, middle, across, thick)
    if rng.random() < 0.2:
        solids += _tunnel(rng, way, width)
    elif rng.random() < 0.28 and kind != "cleats":
        solids += _goods(rng, way, width, thick if kind == "belt" else 0.7 * pitch)
    return assembled(solids)


def _way(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Points of the middle line, and the direction across at each, to the front."""
    kind = rng.choice(
        ["level", "rising", "cranked", "curved"], p=[0.4, 0.18, 0.17, 0.25]
    )
    long, height = rng.uniform(1.4, 3.0), rng.uniform(0.45, 0.9)
    if kind == "curved":
        radius, turn = rng.uniform(0.7, 1.2), rng.choice([1.6, 2.1, 3.1])
        angle = np.linspace(0, turn, round(turn / 0.13))
        out = np.stack([np.sin(angle), np.cos(angle), 0 * angle], axis=1)
        points, across = radius * out + (0, 0, height), out
        tails = rng.uniform(0.0, 0.9, 2)
        for at, tail, sign in ((0, tails[0], -1), (-1, tails[1], 1)):
            if tail > 0.3:
                along = np.array((out[at, 1], -out[at, 0], 0)) * sign
                extra = points[at] + tail * along
                rows = [extra[None], points] if at == 0 else [points, extra[None]]
                points = np.concatenate(rows)
                ends = [out[[at]], across] if at == 0 else [across, out[[at]]]
                across = np.concatenate(ends)
        return points - points.mean(axis=0) * (1, 1, 0), across
    rise = rng.uniform(0.4, 1.0) * (1 if kind != "level" else 0)
    x, z = np.array([0, long]), np.array([0, rise])
    if kind == "cranked":
        x = np.array([0, 0.3 * long, 0.7 * long, long])
        z = np.array([0, 0, rise, rise])
    points = np.stack([x - long / 2, 0 * x, z + height * (0.6 if rise else 1)], axis=1)
    if rng.random() < 0.5:
        points = points[::-1] * (-1, 1, 1) if rise == 0 else points
    return points, np.tile([0.0, 1.0, 0.0], (len(points), 1))


def _stations(
    way: tuple[np.ndarray, np.ndarray], pitch: float
) -> tuple[np.ndarray, np.ndarray]:
    """Places on the middle line at about this pitch, half of it from the ends, and the
    direction across."""
    gaps = np.linalg.norm(np.diff(way[0], axis=0), axis=1)
    run = np.concatenate([[0], np.cumsum(gaps)])
    count = max(2, round(run[-1] / pitch))
    at = run[-1] * (np.arange(count) + 0.5) / count
    places, across = (
        np.stack([np.interp(at, run, column) for column in rows.T], axis=1)
        for rows in way
    )
    return places, across / np.linalg.norm(across, axis=1, keepdims=True)


def _legs(rng: Rng, way: tuple, width: float, thick: float) -> Solids:
    """Pairs of legs with cross bars, or single columns on plates."""
    style, solids = rng.choice(["pairs", "pairs", "splayed", "column"]), []
    places, across = _stations(way, rng.uniform(0.6, 0.95))
    for place, axis in zip(places, across, strict=True):
        top = place - (0, 0, 0.2 * thick)
        floor = top * (1, 1, 0)
        if style == "column":
            beam = 0.5 * width * axis
            solids.append(bar(top - beam, top + beam, 0.06, 0.05))
            solids.append(bar(floor, top, 0.1, 0.1))
            solids.append(rod(floor, floor + (0, 0, 0.02), 0.16, segments=16))
            continue
        spread = 1.35 if style == "splayed" else 1.0
        feet = []
        for side in (-1, 1):
            head = top + side * (width / 2 + 0.005) * axis
            foot = floor + side * (width / 2 + 0.005) * spread * axis
            feet.append((head, foot))
            solids.append(bar(head, foot, 0.05, 0.04))
            solids.append(rod(foot, foot + (0, 0, 0.02), 0.06, segments=10))
        for level in [0.25] if top[2] < 0.6 else [0.25, 0.7]:
            back, front = (level * head + (1 - level) * foot for head, foot in feet)
            solids.append(bar(back, front, 0.03, 0.03))
    return solids


def _guides(points: dict, thick: float) -> Solids:
    """Rails along both sides above the goods' way, on posts."""
    solids = []
    for line in points.values():
        high = line + (0, 0, thick + 0.09)
        for first, last in itertools.pairwise(range(len(line))):
            solids.append(capsule(high[first], high[last], 0.014, segments=8))
        for k in range(0, len(line), max(1, len(line) // 4)):
            solids.append(rod(line[k], high[k], 0.01, segments=6))
        solids.append(rod(line[-1], high[-1], 0.01, segments=6))
    return solids


def _drive(
    rng: Rng, points: dict, middle: np.ndarray, across: np.ndarray, thick: float
) -> Solids:
    """Motor at the end's roller, or hung below the middle."""
    radius = rng.uniform(0.06, 0.09)
    if rng.random() < 0.6:
        side = float(np.sign(across[-1, 1]) or 1) * rng.choice([-1, 1])
        turn = (-90, 0, 0) if side > 0 else (90, 0, 0)
        parts = motor(rng, radius, 3.2 * radius)
        parts.append(box((0, 0, 0), (2.4 * radius, 2.4 * radius, 0.08), 0.01))
        angle = float(np.degrees(np.arctan2(across[-1, 0], across[-1, 1])))
        parts = [part.rotate(turn).rotate((0, 0, -angle)) for part in parts]
        hub = (
            middle[-1] + side * np.linalg.norm(points[1][-1] - middle[-1]) * across[-1]
        )
        return [part.translate(hub + 0.03 * side * across[-1]) for part in parts]
    k = len(middle) // 2
    center = (middle[k] + middle[k - 1]) / 2 - (0, 0, 0.5 * thick + 0.12)
    half = 0.2 * across[k]
    drum = rod(center - half, center + half, radius, segments=16)
    return [box(center + (0, 0, 0.05), (0.34, 0.3, 0.2), 0.015), drum]


def _goods(rng: Rng, way: tuple, width: float, rise: float) -> Solids:
    solids = []
    places, across = _stations(way, rng.uniform(0.45, 0.8))
    for place, axis in zip(places, across, strict=True):
        if rng.random() < 0.7:
            size = rng.uniform(0.16, 0.3, 3) * (1.0, min(1.0, width / 0.35), 1.0)
            turn = -float(np.degrees(np.arctan2(axis[0], axis[1])))
            crate = box((0, 0, size[2] / 2), size).rotate((0, 0, turn))
            solids.append(crate.translate(place + (0, 0, 0.5 * rise - 0.03)))
    return solids


def _tunnel(rng: Rng, way: tuple, width: float) -> Solids:
    """A hood or an inspection unit that goods pass through, on its own feet."""
    k = len(way[0]) // 2
    middle, axis = (way[0][k] + way[0][k - 1]) / 2, way[1][k]
    turn = -float(np.degrees(np.arctan2(axis[0], axis[1])))
    long, tall, wide = rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.45), width + 0.16
    low = middle[2] + rng.uniform(0.15, 0.22)
    solids = [box((0, 0, low + tall / 2), (long, wide, tall), 0.012)]
    for side in (-1, 1):
        wall = (0.6 * long, 0.04, low + 0.05)
        solids.append(box((0, side * (width / 2 + 0.05), wall[2] / 2), wall))
        solids.append(box((0, side * (width / 2 + 0.05), 0.02), (long, 0.1, 0.04)))
    solids.append(box((0, 0, middle[2] - 0.06), (0.06, width + 0.12, 0.06)))
    solids.append(box((0, wide / 2, low + 0.55 * tall), (0.6 * long, 0.04, 0.4 * tall)))
    center = middle * (1, 1, 0)
    return [part.rotate((0, 0, turn)).translate(center) for part in solids]
