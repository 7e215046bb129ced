"""Random structures of many like parts, and compositions: parts made of parts, each
symmetric in its own way.
"""

import itertools

import numpy as np
from manifold3d import CrossSection, Manifold

from experiments.simulation.open_shapes.attachments import (
    any_rotation,
    cut_out,
    extent,
    is_mirrored,
    largest_piece,
    mirrored,
    set_onto,
    stand,
    symmetry,
    touched,
)
from experiments.simulation.open_shapes.frames import (
    frame,
    hollow_prism,
    lattice,
    linkage,
    polygon_frame,
    thickness,
    tub,
    vase,
)
from experiments.simulation.open_shapes.outlines import circle, path
from experiments.simulation.open_shapes.primitives import (
    Make,
    Rng,
    Size,
    any_axis,
    block,
    cuboid,
    dished_plate,
    even,
    frustum,
    pill,
    pipe_along,
    primitive,
    prism_of_outline,
)
from experiments.simulation.solids import place, ring_of, rod, union


def structure(rng: Rng, size: Size) -> Manifold:
    """One of `STRUCTURES`."""
    return STRUCTURES[rng.choice(len(STRUCTURES), p=_WEIGHTS)](rng, size)


def stack(rng: Rng, size: Size) -> Manifold:
    """Two to six blocks on one another about one axis, wider and narrower ones."""
    count = int(rng.integers(2, 7))
    shares = np.exp(rng.uniform(np.log(0.08), 0.0, count))
    heights = shares / shares.sum() * size[2]
    widths = np.exp(rng.uniform(np.log(0.25), 0.0, count))
    make: Make = frustum if rng.random() < 0.5 else block
    level, solids = -size[2] / 2, []
    for height, width in zip(heights, widths / widths.max(), strict=True):
        own = np.array([*(width * size[:2]), height * 1.02])
        solids.append(make(rng, own).translate((0, 0, level + height / 2)))
        level += height
    return union(solids)


def comb(rng: Rng, size: Size) -> Manifold:
    """Rows of like blocks or capsules on a plate: fins, pins, teeth, bottles."""
    make: Make = pill if rng.random() < 0.2 else block
    return grid(rng, size, make)


def grid(rng: Rng, size: Size, make: Make, largest: int = 20) -> Manifold:
    """A plate with rows of what `make` builds, no more than `largest`, in contact with
    it where a line through the middle meets them."""
    layouts = ((1, 2), (1, 3), (2, 2), (1, 4), (2, 3), (1, 9), (3, 4), (5, 4))
    fitting = [counts for counts in layouts if np.prod(counts) <= largest]
    counts = np.array(fitting[rng.choice(len(fitting))])[:: rng.choice([-1, 1])]
    base, cell = size[2] * rng.uniform(0.05, 0.4), size[:2] / counts
    share = rng.uniform(0.3, 0.85, 2)
    if rng.random() < 0.2:
        share = np.array([0.95, 0.2])[:: rng.choice([-1, 1])]
    part = make(rng, np.array([*(cell * share), size[2] - base]))
    foot = touched(part, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    if foot is None:
        return grid(rng, size, block, largest)
    level = base - size[2] / 2 - foot.point[2] - min(foot.depth, base) / 2
    spots = itertools.product(*[(np.arange(n) + 0.5) / n - 0.5 for n in counts])
    parts = [part.translate((x * size[0], y * size[1], level)) for x, y in spots]
    plate = cuboid(rng, np.array([*size[:2], base]))
    return union([plate.translate((0, 0, (base - size[2]) / 2)), *parts])


def wheel(rng: Rng, size: Size) -> Manifold:
    """A hub with spokes or blades about z, and a rim in most."""
    size = even(rng, size, 1.0)
    radius, tall = size[0] / 2, min(size[2], rng.uniform(0.1, 0.6) * size[0])
    hub, count = radius * rng.uniform(0.1, 0.4), int(rng.integers(3, 9))
    solids = [frustum(rng, np.array([2 * hub, 2 * hub, tall]))]
    long, thick = radius - 0.5 * hub, thickness(rng, size)
    own = np.array([long, rng.uniform(0.15, 0.5) * radius, 0.5 * tall])
    if rng.random() < 0.5:
        own[1:] = thick, min(thick * rng.uniform(1, 3), tall)
        spoke = cuboid(rng, own)
    else:
        spoke = dished_plate(rng, own).rotate((rng.uniform(-40, 40), 0, 0))
    solids += ring_of(spoke.translate((radius - long / 2 - 0.6 * thick, 0, 0)), count)
    if rng.random() < 0.65:
        inner, half = radius - 1.5 * thick, tall * rng.uniform(0.2, 0.5)
        rim = [(inner, -half), (radius, -half), (radius, half), (inner, half)]
        solids.append(CrossSection([np.array(rim)]).revolve(28))
    return union(solids)


def cage(rng: Rng, size: Size) -> Manifold:
    """Plates at both ends, posts between them around the edge or in the corners."""
    thick = min(thickness(rng, size, 0.02), size[:2].min() / 6)
    plate = block(rng, np.array([size[0], size[1], size[2] * rng.uniform(0.05, 0.25)]))
    radii, count = rng.uniform(0.55, 0.85) * size[:2] / 2, int(rng.choice([3, 4, 6, 8]))
    if rng.random() < 0.4:
        radii = radii * 0.2
    spots = circle(count, np.pi / count) * radii
    levels = [-1, 1] if rng.random() < 0.6 else [-1, 0, 1]
    room = size[2] / 2 - plate.bounding_box()[5]
    solids = [plate.translate((0, 0, level * room)) for level in levels]
    solids += [rod((x, y, -room), (x, y, room), thick, segments=10) for x, y in spots]
    return union(solids)


def beads(rng: Rng, size: Size) -> Manifold:
    """Like parts at even steps along a thin pipe or rod."""
    line = path(rng) * size * 0.8
    if rng.random() < 0.5:
        line = np.array([(0, 0, -0.5), (0, 0, 0.5)]) * size
    thick = thickness(rng, size) / 2
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    count = int(rng.integers(3, 8))
    steps = np.linspace(along[-1] * 0.08, along[-1] * 0.92, count)
    spots = np.stack([np.interp(steps, along, c) for c in line.T], axis=1)
    own = np.minimum(rng.uniform(0.3, 1.0, 3) * along[-1] / count, size)
    part = block(rng, np.maximum(own, 3 * thick))
    return union([pipe_along(line, thick), *(part.translate(spot) for spot in spots)])


_MADE: dict[Make, tuple[float, bool]] = {
    frame: (0.18, False),
    lattice: (0.08, True),
    polygon_frame: (0.06, False),
    tub: (0.14, True),
    vase: (0.06, False),
    hollow_prism: (0.1, True),
    stack: (0.12, True),
    comb: (0.1, True),
    wheel: (0.07, True),
    cage: (0.06, True),
    beads: (0.04, False),
    linkage: (0.12, False),
}
"""How often each is drawn, and whether along any axis."""


STRUCTURES: tuple[Make, ...] = tuple(
    any_axis(make) if turns else make for make, (_, turns) in _MADE.items()
)
_WEIGHTS = np.array([weight for weight, _ in _MADE.values()])
_WEIGHTS /= _WEIGHTS.sum()


def composition(rng: Rng) -> Manifold:
    """A body in one piece, of the order of one large: on a stand or its own underside,
    upright or lying any way."""
    body, posture = composite(rng, sides(rng, 1.0), 2), rng.random()
    if posture < 0.1:
        body = place(body, any_rotation(rng), np.zeros(3))
    elif posture < 0.25:
        body = place(body, np.roll(np.eye(3), 1, axis=1), np.zeros(3))
    if rng.random() < 0.55:
        body = largest_piece(union([body, *stand(rng, body)]))
    return body


def composite(rng: Rng, size: Size, depth: int) -> Manifold:
    """A body, cut in some, with parts set onto it that are composites themselves, as
    deep as that; or rows of one composite on a plate."""
    if depth > 0 and rng.random() < 0.08:
        return largest_piece(grid(rng, size, lambda r, own: composite(r, own, 0), 6))
    body = structure(rng, size) if rng.random() < 0.5 else primitive(rng, size)
    body, group = largest_piece(body), symmetry(rng)
    for _ in range(int(rng.choice([0, 0, 1, 2]))):
        _, own = extent(body)
        tool = sides(rng, own.max() * rng.uniform(0.1, 0.5))
        make = block if rng.random() < 0.7 else prism_of_outline
        body = cut_out(rng, body, make(rng, tool), group)
    solids, last = [body], body
    for _ in range(int(rng.integers(depth > 1, 2 + depth))):
        own = sides(rng, size.max() * np.exp(rng.uniform(np.log(0.15), np.log(0.75))))
        # What is repeated often is simple.
        is_deep = depth > 0 and len(group) <= 2 and rng.random() < 0.6
        part = composite(rng, own, depth - 1) if is_deep else primitive(rng, own)
        target = body if rng.random() < 0.6 else last
        placed = set_onto(rng, target, part, group)
        if placed:
            last = placed[0]
            solids += placed
    whole = union(solids)
    if is_mirrored(group) and rng.random() < 0.85:
        whole = mirrored(whole)
    return largest_piece(whole)


def sides(rng: Rng, longest: float) -> Size:
    """A box's sides, the longest of them given, the others down to a fifth of it."""
    shares = np.exp(rng.uniform(np.log(0.2), 0.0, 3))
    return longest * shares / shares.max()
