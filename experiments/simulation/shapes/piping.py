"""Procedural pipe runs."""

import itertools

import numpy as np
from manifold3d import Manifold

from experiments.simulation.shapes.valves import flange, hand_wheel
from experiments.simulation.solids import (
    assembled,
    ball,
    bar,
    box,
    place,
    rod,
    torus,
    tube,
)

Rng = np.random.Generator
MAX_TRIES = 40


def pipe_run(rng: Rng) -> list[Manifold]:
    """A winding pipe with bends, flanges, tees and a valve; several side by side on a
    rack; a header with branches; a loop; a hand-valved manifold."""
    kind = rng.choice(["winding", "rack", "header", "loop"], p=[0.42, 0.22, 0.18, 0.18])
    radius = rng.uniform(0.035, 0.075)
    if kind == "rack":
        return assembled(_rack(rng, radius))
    if kind == "header":
        return assembled(_header(rng, radius * 1.3))
    if kind == "loop":
        return assembled(_loop(rng, radius))
    points = _winding(rng, int(rng.integers(4, 8)), radius)
    solids = _pipe(rng, points, radius)
    solids += _supports(rng, points, radius)
    return assembled(solids + _branches(rng, points, radius))


def _winding(rng: Rng, count: int, radius: float) -> np.ndarray:
    """Corners of a way along the axes that keeps clear of itself."""
    for _ in range(MAX_TRIES):
        points, last = [np.array((0.0, 0.0, rng.uniform(0.3, 0.8)))], -1
        for _ in range(count):
            axis = int(rng.choice([a for a in range(3) if a != last]))
            step, sign = np.zeros(3), rng.choice([-1, 1], p=[0.3, 0.7])
            step[axis] = sign * rng.uniform(8, 18) * radius
            points.append(points[-1] + step)
            last = axis
        way = np.array(points)
        if way[:, 2].min() > 3 * radius and _is_clear(way, 4 * radius):
            return way
    return way[:4] + (0, 0, max(0.0, 3 * radius - way[:4, 2].min()))


def _is_clear(way: np.ndarray, gap: float) -> bool:
    """Are legs that are not neighbours apart, and is none reversed?"""
    share = np.linspace(0, 1, 9)[:, None]
    lines = [a + share * (b - a) for a, b in itertools.pairwise(way)]
    for i, j in itertools.combinations(range(len(lines)), 2):
        gaps = np.linalg.norm(lines[i][:, None] - lines[j][None], axis=-1)
        if j > i + 1 and gaps.min() < gap:
            return False
    return True


def _pipe(rng: Rng, points: np.ndarray, radius: float) -> list[Manifold]:
    """Straight lengths joined by bends; flanges or sleeves at some joints and at the
    ends, which are open."""
    solids, trim = [], 2.6 * radius
    joint = str(rng.choice(["flange", "sleeve", "none"], p=[0.5, 0.3, 0.2]))
    count, legs = int(rng.choice([0, 0, 4])), []
    for index, (start, end) in enumerate(itertools.pairwise(points)):
        along = (end - start) / np.linalg.norm(end - start)
        first = start + trim * along * (index > 0)
        last = end - trim * along * (index < len(points) - 2)
        legs.append((first, last, along))
        ends = first - 0.002 * along, last + 0.002 * along
        solids.append(rod(*ends, radius, segments=12))
    for before, after in itertools.pairwise(legs):
        solids.append(_bend(before[1], before[2], after[2], trim, radius))
        sides = ((before[1], before[2]), (after[0], -after[2]))
        for point, along in sides if len(legs) < 5 else sides[:1]:
            if joint == "flange":
                place_at = point - 0.5 * radius * along
                solids += flange(place_at, along, 1.9 * radius, 0.4 * radius, count)
            elif joint == "sleeve":
                ends = point - 0.6 * radius * along, point + 0.1 * radius * along
                solids.append(rod(*ends, 1.22 * radius, segments=12))
    bore = 0.78 * radius * (rng.random() < 0.8)
    for point, out in ((legs[0][0], -legs[0][2]), (legs[-1][1], legs[-1][2])):
        solids += _open_end(point, out, radius, bore, count)
    return solids


def _open_end(
    point: np.ndarray, out: np.ndarray, radius: float, bore: float, count: int
) -> list[Manifold]:
    """The last length of a pipe, from one radius before `point` to one behind it."""
    near, end = point - radius * out, point + radius * out
    rim = flange(end - 0.5 * radius * out, out, 2 * radius, 0.5 * radius, count, bore)
    return [*rim, tube(near, end, radius, bore, 12)]


def _bend(
    start: np.ndarray, into: np.ndarray, out: np.ndarray, trim: float, radius: float
) -> Manifold:
    """A quarter of a torus from `start`, turning from one direction to the other."""
    if abs(into @ out) > 0.9:
        return rod(start, start + 2 * trim * into, radius, segments=12)
    arc = torus(trim, radius, 90.0, 20, 12)
    frame = np.stack([-out, into, np.cross(-out, into)], axis=1)
    return place(arc, frame, start + trim * out)


def _supports(rng: Rng, points: np.ndarray, radius: float) -> list[Manifold]:
    solids = []
    for start, end in itertools.pairwise(points):
        middle, level = (start + end) / 2, start[2] == end[2]
        hidden = any(
            np.linalg.norm((a + b)[:2] / 2 - middle[:2]) < 4 * radius
            and (a + b)[2] / 2 < middle[2] - radius
            for a, b in itertools.pairwise(points)
        )
        if level and middle[2] < 1.1 and not hidden and rng.random() < 0.75:
            foot = middle * (1, 1, 0)
            solids.append(bar(foot, middle, 1.1 * radius, 1.1 * radius))
            solids.append(box(foot + (0, 0, 0.01), (4 * radius, 4 * radius, 0.02)))
            solids.append(
                box(middle - (0, 0, radius), (2.6 * radius, 2.6 * radius, radius))
            )
    return solids


def _branches(rng: Rng, points: np.ndarray, radius: float) -> list[Manifold]:
    """On some lengths a tee, a hand valve, a gauge or a drum."""
    solids = []
    for start, end in itertools.pairwise(points):
        along = (end - start) / np.linalg.norm(end - start)
        middle = 0.62 * start + 0.38 * end
        kind = rng.choice(
            ["none", "valve", "gauge", "drum", "tee"], p=[0.46, 0.22, 0.1, 0.08, 0.14]
        )
        up = np.array((0, 0, 1.0)) if abs(along[2]) < 0.5 else np.array((0, 1.0, 0))
        if kind == "valve":
            solids += valve_on(rng, middle, along, up, radius)
        elif kind == "tee":
            tip = middle + rng.uniform(4, 7) * radius * up
            solids.append(rod(middle, tip, 0.8 * radius, segments=12))
            solids += flange(tip, -up, 1.7 * radius, 0.4 * radius, 4)
        elif kind == "gauge":
            tip = middle + 2.6 * radius * up
            solids.append(rod(middle, tip, 0.25 * radius, segments=8))
            face = (
                np.array((0, 1.0, 0)) if abs(along[2]) < 0.5 else np.array((0, 0, 1.0))
            )
            ends = tip + 0.8 * radius * up
            solids.append(
                rod(
                    ends - 0.3 * radius * face, ends + 0.5 * radius * face, 1.1 * radius
                )
            )
        elif kind == "drum":
            half = 1.9 * radius * along
            solids.append(rod(middle - half, middle + half, 2.0 * radius, segments=20))
    return solids


def valve_on(
    rng: Rng, middle: np.ndarray, along: np.ndarray, up: np.ndarray, radius: float
) -> list[Manifold]:
    """A small valve on a pipe: body, two flanges, bonnet and wheel."""
    solids = [ball(middle, 1.7 * radius, 14)]
    for side in (-1, 1):
        near = middle + side * 1.7 * radius * along
        solids += flange(near, side * along, 1.9 * radius, 0.4 * radius)
    stem = [rod((0, 0, 0), (0, 0, 4 * radius), 0.4 * radius, segments=12)]
    stem.append(rod((0, 0, 0), (0, 0, 2.4 * radius), 1.0 * radius, segments=12))
    stem += hand_wheel(rng, rng.uniform(1.6, 2.4) * radius, 4 * radius, 14)
    frame = np.stack([along, np.cross(up, along), up], axis=1)
    return solids + [place(part, frame, middle) for part in stem]


def _rack(rng: Rng, radius: float) -> list[Manifold]:
    """Pipes of several sizes side by side over frames; one or two turn down."""
    count, bays = int(rng.integers(2, 5)), int(rng.integers(2, 4))
    long, height = rng.uniform(1.3, 2.2), rng.uniform(0.6, 1.2)
    sizes = radius * rng.uniform(0.5, 1.2, count)
    gap, y, places = 0.6 * radius, 0.0, []
    for size in sizes:
        places.append(y + 1.6 * size)
        y += 3.2 * size + gap
    solids, middle = [], (y - gap) / 2
    for size, row in zip(sizes, np.array(places) - middle, strict=True):
        ends = np.array([(-long / 2, row, 0), (long / 2, row, 0.0)])
        ends[:, 2] = height + size - 0.004
        if rng.random() < 0.4:
            drop = ends[1] + (0.12, 0, 0)
            way = np.array([ends[0], drop, drop * (1, 1, 0) + (0, 0, 0.12)])
        elif rng.random() < 0.3:
            way = np.array([ends[0], ends[1], ends[1] + (0, 0, rng.uniform(0.25, 0.5))])
        else:
            way = ends
        solids += _pipe(rng, way, float(size))
        if rng.random() < 0.35:
            spot = ends[0] + (rng.uniform(0.2, 0.7) * long, 0, 0)
            up, along = np.array((0, 0, 1.0)), np.array((1.0, 0, 0))
            solids += valve_on(rng, spot, along, up, float(size))
    decks = [height - 0.03] + [height * 0.45] * int(rng.random() < 0.3)
    for x in np.linspace(-0.4, 0.4, bays) * long:
        for row in (-middle - 0.03, middle + 0.03):
            solids.append(box((x, row, height / 2), (0.06, 0.06, height)))
            solids.append(box((x, row, 0.01), (0.14, 0.14, 0.02)))
        solids += [box((x, 0, z), (0.06, 2 * middle + 0.06, 0.06)) for z in decks]
    return solids


def _header(rng: Rng, radius: float) -> list[Manifold]:
    """A thick closed pipe with branches upwards or to the front, some with valves."""
    count, long = int(rng.integers(2, 6)), rng.uniform(1.0, 1.8)
    height, small = rng.uniform(0.3, 0.7), radius * rng.uniform(0.4, 0.65)
    ends = np.array((-long / 2, 0, height)), np.array((long / 2, 0, height))
    solids = [rod(*ends, radius, segments=24)]
    for end, out in zip(ends, (-1, 1), strict=True):
        if rng.random() < 0.5:
            solids.append(ball(end, (0.6 * radius, radius, radius), 20))
        else:
            solids += flange(end, (-out, 0, 0), 1.7 * radius, 0.35 * radius, 8)
            solids += flange(end, (out, 0, 0), 1.7 * radius, 0.3 * radius)
    up = rng.random() < 0.65
    for x in np.linspace(-0.38, 0.38, count) * long:
        root = np.array((x, 0, height))
        tall = radius + 6.5 * small + rng.uniform(0.0, 0.25)
        tip = root + (0, 0, tall)
        way = np.array([root, tip])
        if not up:
            way = np.array([root, root + (0, tall, 0)])
        elif rng.random() < 0.4:
            way = np.array([root, tip, tip + (0, rng.uniform(0.2, 0.4), 0)])
        solids += _pipe(rng, way, small) if len(way) > 2 else _spur(way, small)
        if rng.random() < 0.45:
            along = (way[1] - way[0]) / np.linalg.norm(way[1] - way[0])
            middle = root + (radius + 3.2 * small) * along
            side = np.array((0, 1.0, 0)) if up else np.array((0, 0, 1.0))
            solids += valve_on(rng, middle, along, side, small)
    for x in (-0.3 * long, 0.3 * long):
        solids.append(box((x, 0, height / 2), (0.06, 0.8 * radius, height)))
        solids.append(box((x, 0, 0.01), (0.16, 2.4 * radius, 0.02)))
        solids.append(box((x, 0, height - 0.8 * radius), (0.06, 1.9 * radius, radius)))
    return solids


def _spur(way: np.ndarray, radius: float) -> list[Manifold]:
    """A straight branch with an open end."""
    along = (way[1] - way[0]) / np.linalg.norm(way[1] - way[0])
    stub = rod(way[0], way[1], radius, segments=12)
    return [stub, *_open_end(way[1], along, radius, 0.75 * radius, 4)]


def _loop(rng: Rng, radius: float) -> list[Manifold]:
    """An expansion loop, or a serpentine of several turns, lying or upright."""
    turns, reach = int(rng.integers(1, 4)), rng.uniform(0.4, 0.8)
    step, tail = rng.uniform(6, 8) * radius, rng.uniform(0.25, 0.5)
    flat = [(-tail, 0.0), (0.0, 0.0)]
    for turn in range(turns):
        x = 2 * turn * step
        flat += [(x, reach), (x + step, reach), (x + step, 0.0)]
        flat += [(x + 2 * step, 0.0)] if turn < turns - 1 else []
    flat.append((flat[-1][0] + tail, 0.0))
    way = np.array([(x, y, 0.0) for x, y in flat])
    way -= (way.max(axis=0) + way.min(axis=0)) / 2
    if rng.random() < 0.5:
        way = way[:, [0, 2, 1]]
    way[:, 2] += rng.uniform(4, 8) * radius - way[:, 2].min()
    solids = _pipe(rng, way, radius) + _supports(rng, way, radius)
    if rng.random() < 0.5:
        middle = 0.5 * (way[0] + way[1])
        along, up = np.array((1.0, 0, 0)), np.array((0, 0, 1.0))
        solids += valve_on(rng, middle, along, up, radius)
    return solids
