"""Random frames of bars, thin shells around a hollow, and linkages of turned links."""

import itertools

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, OpType
from scipy.spatial.transform import Rotation

from experiments.simulation.open_shapes.attachments import touched
from experiments.simulation.open_shapes.outlines import circle, outline, profile
from experiments.simulation.open_shapes.primitives import (
    Make,
    Rng,
    Size,
    block,
    cuboid,
    ellipsoid,
    even,
    fitted,
    frustum,
    loft_of_outlines,
    primitive,
)
from experiments.simulation.solids import bar, box, capsule, place, rod, union


def thickness(rng: Rng, size: Size, low: float = 0.012, high: float = 0.07) -> float:
    """Of a wall or bar: a share of the longest side, within a third of the shortest."""
    share = np.exp(rng.uniform(np.log(low), np.log(high)))
    return float(min(share * size.max(), size.min() / 3))


def frame(rng: Rng, size: Size) -> Manifold:
    """Square bars along the edges of cells, with shelves and walls in some: a box
    without the openings along one, two or three axes."""
    thick = thickness(rng, size, 0.015)
    ticks = [
        np.linspace(thick - side, side - thick, int(rng.choice([2, 2, 3, 4]))) / 2
        for side in size
    ]
    closed = rng.random(3) < 0.3
    closed[rng.integers(3)] = False
    openings = []
    for axis in np.flatnonzero(~closed):
        others = [ticks[other] for other in range(3) if other != axis]
        has_back = rng.random() < 0.2
        for cell in itertools.product(*map(itertools.pairwise, others)):
            low, high = np.transpose(cell)
            opening = np.insert(high - low - thick, axis, size[axis] + thick)
            center = np.insert((low + high) / 2, axis, 1.5 * thick * has_back)
            if opening.min() > 0:
                openings.append(box(center, opening))
    return box((0, 0, 0), size) - union(openings)


def lattice(rng: Rng, size: Size) -> Manifold:
    """A flat grid of bars in the x, z plane, as of ladders, fences and girders; or two
    of them with bars between."""
    columns, rows = (
        int(n) for n in rng.choice([(1, 6), (6, 1), (8, 1), (4, 3), (3, 3)])
    )
    thick = min(thickness(rng, size), 0.25 * min(size[0] / columns, size[2] / rows))
    x = np.linspace(thick - size[0], size[0] - thick, columns + 1) / 2
    z = np.linspace(thick - size[2], size[2] - thick, rows + 1) / 2
    crossed, openings = rng.random() < 0.4, []
    for (left, right), (low, high) in itertools.product(
        itertools.pairwise(x), itertools.pairwise(z)
    ):
        cell = np.array([(left, low), (right, low), (right, high), (left, high)])
        for part in (cell[[0, 1, 2]], cell[[0, 2, 3]]) if crossed else (cell,):
            openings.append(CrossSection([part]).offset(-thick / 2, JoinType.Miter))
    plate = CrossSection.square((size[0], size[2]), True)
    section = CrossSection.batch_boolean([plate, *openings], OpType.Subtract)
    deep = size[1] if rng.random() < 0.5 else thick
    flat = section.extrude(deep).translate((0, 0, -deep / 2)).rotate((90, 0, 0))
    if size[1] < 4 * thick or rng.random() < 0.4:
        return flat
    y, flat = (size[1] - thick) / 2, fitted(flat, np.array([size[0], thick, size[2]]))
    ties = [
        box((x_tie, 0, z_tie), (thick, size[1] - thick, thick))
        for x_tie in x[[0, -1]]
        for z_tie in z[[0, -1]]
    ]
    return union([flat.translate((0, -y, 0)), flat.translate((0, y, 0)), *ties])


def polygon_frame(rng: Rng, size: Size) -> Manifold:
    """Round bars between two polygons, one above the other, with knots in some."""
    count, thick = int(rng.integers(3, 6)), thickness(rng, size) / 2
    half, top = size / 2 - thick, rng.uniform(0.3, 1.0)
    ring = circle(count, np.pi / count - np.pi / 2)
    low = np.column_stack([ring * half[:2], np.full(count, -half[2])])
    high = np.column_stack([top * ring * half[:2], np.full(count, half[2])])
    style, ends = rng.integers(4), []
    for k in range(count):
        following = (k + 1) % count
        ends += [(low[k], high[k]), (high[k], high[following])]
        if style != 1:
            ends.append((low[k], low[following]))
        if style == 2:
            ends.append((low[k], high[following]))
    solids = [rod(start, end, thick, segments=8) for start, end in ends]
    knot = ellipsoid(rng, np.full(3, 4 * thick))
    if rng.random() < 0.5:
        solids += [knot.translate(point) for point in (*low, *high)]
    return union(solids)


def tub(rng: Rng, size: Size) -> Manifold:
    """A box, frustum or loft with thin walls, open at one end."""
    make: Make = (cuboid, frustum, loft_of_outlines)[rng.choice(3, p=(0.5, 0.35, 0.15))]
    solid, wall = make(rng, size), thickness(rng, size)
    lower, upper = np.array(solid.bounding_box()).reshape(2, 3)
    extent = upper - lower
    inner = solid.scale((extent - (2 * wall, 2 * wall, 0.99 * wall)) / extent)
    return solid - inner.translate((0, 0, 0.51 * wall))


def vase(rng: Rng, size: Size) -> Manifold:
    """A random profile turned about z, hollow and open at its top."""
    size = even(rng, size, 1.0)
    line = profile(rng) * (size[0] / 2, size[2])
    wall = min(thickness(rng, size), 0.6 * line[-1, 0])
    section = CrossSection([np.concatenate([line, (line * (-1, 1))[::-1]])])
    mouth = CrossSection.square((2 * (line[-1, 0] - wall), 4 * wall), True)
    hollow = section.offset(-wall, JoinType.Miter) + mouth.translate((0, size[2]))
    return (section - hollow).revolve(24).translate((0, 0, -size[2] / 2))


def hollow_prism(rng: Rng, size: Size) -> Manifold:
    """A random outline's rim drawn upwards: pipes, channels, rings."""
    section = CrossSection([outline(rng) * size[:2]])
    inner = section.offset(-thickness(rng, size), JoinType.Miter)
    return (section - inner).extrude(size[2]).translate((0, 0, -size[2] / 2))


LINKS = ("rod", "bar", "capsule", "plates", "hull")


def linkage(rng: Rng, size: Size) -> Manifold:
    """A base, two to five links in a random posture above it, and what they hold."""
    count, thick = (
        int(rng.integers(2, 6)),
        np.exp(rng.uniform(np.log(0.05), np.log(0.25))),
    )
    lengths = rng.uniform(0.5, 1.2, count) * rng.uniform(0.7, 1.0) ** np.arange(count)
    radii = thick * np.linspace(1.0, rng.uniform(0.4, 1.0), count + 1) / 2
    base = rng.uniform([2, 2, 0.5], [8, 8, 4]) * thick
    solids = [block(rng, base)]
    point, frame = np.array([0.0, 0.0, base[2] / 2]), np.eye(3)
    kind, rolls = str(rng.choice(LINKS)), rng.random() < 0.4
    for index, length in enumerate(lengths):
        bend = rng.uniform(-0.9, 0.9) if index == 0 else rng.uniform(-2.2, 2.2)
        roll = rng.uniform(-np.pi, np.pi) if rolls else 0.0
        # About the link's own axis, z, then about its joint's, x.
        turns = Rotation.from_euler("ZX", [(roll, bend), (roll, -bend)]).as_matrix()
        turned = [frame @ turn for turn in turns]
        # Of the two ways to bend, the one that keeps off the floor.
        is_low = point[2] + length * turned[0][2, 2] < 0
        frame = turned[int(is_low)]
        solids += _link(rng, kind, point, frame, length, radii[index : index + 2])
        point = point + length * frame[:, 2]
    held = primitive(rng, radii[-1] * np.exp(rng.uniform(np.log(2), np.log(12), 3)))
    foot = touched(held, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    if foot is not None:
        sink = foot.point + (0, 0, min(foot.depth, radii[-1]) / 2)
        solids.append(place(held.translate(-sink), frame, point))
    return _within(union(solids), size)


def _link(
    rng: Rng,
    kind: str,
    start: np.ndarray,
    frame: np.ndarray,
    length: float,
    radii: np.ndarray,
) -> list[Manifold]:
    """A joint across x at the start, and the body from there along z."""
    end, axis = start + length * frame[:, 2], frame[:, 0]
    wide, slim = radii
    joint = rod(start - 1.6 * wide * axis, start + 1.6 * wide * axis, 1.2 * wide)
    if kind == "rod":
        return [joint, rod(start, end, 0.9 * wide, 0.9 * slim, 14)]
    if kind == "capsule":
        return [joint, capsule(start, end, wide, slim, 12)]
    if kind == "bar":
        return [joint, bar(start, end, 1.6 * wide, 1.2 * wide, slim / wide)]
    if kind == "hull":
        ends = [
            rod(point - radius * axis, point + radius * axis, radius, segments=14)
            for point, radius in ((start, wide), (end, slim))
        ]
        return [joint, Manifold.batch_hull(ends)]
    plates = [
        box((side * wide, 0, length / 2), (0.5 * wide, 1.6 * wide, length + wide))
        for side in (-1, 1)
    ]
    pin = rod(end - 1.2 * wide * axis, end + 1.2 * wide * axis, 0.7 * wide)
    return [joint, pin, *(place(plate, frame, start) for plate in plates)]


def _within(solid: Manifold, size: Size) -> Manifold:
    """The solid, centred, as large as the box takes it."""
    lower, upper = np.array(solid.bounding_box()).reshape(2, 3)
    scale = float((size / (upper - lower)).min())
    return solid.translate(-(lower + upper) / 2).scale((scale, scale, scale))
