"""Random frames of bars, square and round, in a box."""

import itertools

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, OpType

from experiments.simulation.open_shapes.outlines import circle
from experiments.simulation.open_shapes.primitives import Rng, Size, ellipsoid, fitted
from experiments.simulation.solids import box, rod, union


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
    y = (size[1] - thick) / 2
    flat = fitted(flat, np.array([size[0], thick, size[2]]))
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
