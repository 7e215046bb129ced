"""How parts come together: where a solid can be touched, what is set onto it or cut out
of it there, the copies that its symmetry asks for, and what a body stands on.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from experiments.simulation.open_shapes.outlines import circle
from experiments.simulation.open_shapes.primitives import Rng, block
from experiments.simulation.solids import (
    Solids,
    axes_along,
    ball,
    bar,
    place,
    ring_of,
    rod,
    union,
)

Point = Float64[np.ndarray, "3"]
Symmetry = tuple[np.ndarray, ...]  # 3x3 matrices about the origin, the identity first

MIRROR = np.diag([-1.0, 1.0, 1.0])
FACES = np.concatenate([np.eye(3), -np.eye(3)])
"""Directions out of a box: right, front, top, left, back, bottom."""


class Contact(NamedTuple):
    """Where a ray enters a solid, the surface's normal, how far the solid goes on."""

    point: Point
    normal: Point
    depth: float


def extent(solid: Manifold) -> tuple[Point, Point]:
    """Middle and sides of a solid's box."""
    lower, upper = np.array(solid.bounding_box()).reshape(2, 3)
    return (lower + upper) / 2, upper - lower


def largest_piece(solid: Manifold) -> Manifold:
    """The piece of most volume, its enclosed voids filled."""
    return max(solid.decompose(), key=Manifold.volume)


def touched(solid: Manifold, through: Point, direction: Point) -> Contact | None:
    """The first contact of the line through a point, along a unit vector; None if the
    line misses."""
    middle, sides = extent(solid)
    reach = float(np.linalg.norm(sides) + np.linalg.norm(middle - through))
    hits = solid.ray_cast(through - reach * direction, through + reach * direction)
    if len(hits) < 2:
        return None
    first, second = (np.array(hit.position) for hit in hits[:2])
    depth = float(np.linalg.norm(second - first))
    return Contact(first, np.array(hits[0].normal), depth)


def symmetry(rng: Rng) -> Symmetry:
    """Left and right alike, in some front and back too; or turned about z; or none."""
    kind, flip_y = rng.random(), np.diag([1.0, -1, 1])
    if kind < 0.5:
        return np.eye(3), MIRROR
    if kind < 0.7:
        return np.eye(3), MIRROR, flip_y, MIRROR @ flip_y
    if kind < 0.9:
        count = int(rng.choice([2, 3, 4, 5, 6, 8]))
        turns = np.arange(count) * 2 * np.pi / count
        return tuple(Rotation.from_euler("z", turn).as_matrix() for turn in turns)
    return (np.eye(3),)


def is_mirrored(group: Symmetry) -> bool:
    """Whether left and right are to be alike."""
    return any(np.array_equal(matrix, MIRROR) for matrix in group)


def mirrored(solid: Manifold) -> Manifold:
    """The right half of a solid, and its mirror image for the left half."""
    right = solid.trim_by_plane((1, 0, 0), 0.0)
    return right + right.mirror((1, 0, 0)) if right.volume() > 0 else solid


def copies(solid: Manifold, point: Point, group: Symmetry) -> Solids:
    """A solid at a point, and its copies under a symmetry that moves the point."""
    made: Solids = []
    seen: list[Point] = []
    for matrix in group:
        moved = matrix @ point
        if all(np.abs(moved - other).max() > 1e-6 for other in seen):
            seen.append(moved)
            made.append(place(solid, matrix, np.zeros(3)))
    return made


def spot(rng: Rng, solid: Manifold, outward: Point) -> Point:
    """A point within a solid's box, mostly in line with its middle or even shares of
    its sides as seen from a face."""
    middle, sides = extent(solid)
    shares = rng.choice([0.0, 0.0, 0.25, 0.4, 0.45], 3) * rng.choice([-1, 1], 3)
    free = rng.uniform(-0.45, 0.45, 3)
    shares = np.where(rng.random(3) < 0.2, free, shares)
    return middle + np.where(outward == 0, shares, 0.5 * outward) * sides


def turned_outward(rng: Rng, outward: Point) -> np.ndarray:
    """A rotation that takes z to a direction, in some upright or leaning instead."""
    kind, spin = rng.random(), float(rng.choice([0.0, 90.0, 180.0, 270.0]))
    upright = Rotation.from_euler("z", spin, degrees=True).as_matrix()
    if kind < 0.25:
        return upright
    return axes_along(outward) @ upright if kind < 0.9 else any_rotation(rng)


def any_rotation(rng: Rng) -> np.ndarray:
    """Uniform over all rotations."""
    return Rotation.from_quat(rng.normal(size=4)).as_matrix()


def set_onto(rng: Rng, body: Manifold, part: Manifold, group: Symmetry) -> Solids:
    """The part, set onto the body from one side, and its copies; nothing if no line
    meets both."""
    outward = FACES[rng.choice(6, p=(0.16, 0.13, 0.4, 0.1, 0.13, 0.08))]
    for _ in range(4):
        on_body = touched(body, spot(rng, body, outward), -outward)
        if on_body is None:
            continue
        if rng.random() < 0.3 and on_body.normal @ outward > 0.3:
            outward = on_body.normal
        turned = place(part, turned_outward(rng, outward), np.zeros(3))
        middle, sides = extent(turned)
        on_part = touched(turned, middle, outward)
        if on_part is not None:
            sink = min(on_body.depth / 2, on_part.depth / 2, 0.1 * sides.max())
            shift = on_body.point - on_part.point - sink * outward
            return copies(turned.translate(shift), on_body.point, group)
    return []


def cut_out(rng: Rng, body: Manifold, tool: Manifold, group: Symmetry) -> Manifold:
    """The body without the tool, sunk into one of its sides or driven right through,
    and without its copies; what falls off is dropped."""
    outward = FACES[rng.integers(6)]
    hit = touched(body, spot(rng, body, outward), -outward)
    if hit is None:
        return body
    turned = place(tool, axes_along(outward), np.zeros(3))
    middle, sides = extent(turned)
    along = float(np.abs(sides @ outward))
    deep = hit.depth * (1.2 if rng.random() < 0.6 else rng.uniform(0.2, 0.8))
    stretch = 1 + np.abs(outward) * (1.1 * deep / along - 1)
    sunk = turned.translate(-middle).scale(stretch)
    sunk = sunk.translate(hit.point - 0.45 * deep * outward)
    left = body - union(copies(sunk, hit.point, group))
    return body if left.volume() < 0.4 * body.volume() else largest_piece(left)


UP = np.array([0.0, 0.0, 1.0])


def stand(rng: Rng, body: Manifold) -> Solids:
    """Legs, a pedestal or a plinth; nothing where they find no hold."""
    kind = (legs, pedestal, plinth)[rng.choice(3, p=(0.6, 0.2, 0.2))]
    return kind(rng, body)


def legs(rng: Rng, body: Manifold) -> Solids:
    """Three to six legs, upright or splayed, on feet or wheels, tied together in some
    below or halfway, as runners and stretchers do."""
    middle, sides = extent(body)
    if rng.random() < 0.7:
        ring = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * rng.uniform(0.6, 0.96)
    else:
        count = int(rng.choice([3, 3, 5, 6]))
        ring = circle(count, np.pi / 2) * rng.uniform(0.4, 0.9)
    low = middle[2] - sides[2] / 2 - sides.max() * np.exp(rng.uniform(-2.5, 0.2))
    thick = sides.max() * np.exp(rng.uniform(np.log(0.012), np.log(0.05)))
    splay = 1.0 if rng.random() < 0.6 else rng.uniform(0.8, 1.5)
    tops, feet = [], []
    for share in ring:
        hit = touched(body, middle + np.append(share * (sides[:2] / 2 - thick), 0), UP)
        if hit is not None:
            tops.append(hit.point + min(hit.depth / 2, thick) * UP)
            foot = middle[:2] + splay * (hit.point[:2] - middle[:2])
            feet.append(np.append(foot, low))
    if len(feet) < 3:
        return []
    round_legs, taper = rng.random() < 0.5, rng.choice([1.0, rng.uniform(0.5, 1.0)])
    solids = [
        rod(top, foot, thick, thick * taper, 12)
        if round_legs
        else bar(top, foot, 2 * thick, 2 * thick, taper)
        for top, foot in zip(tops, feet, strict=True)
    ]
    return [*solids, *_ties(rng, tops, feet, thick), *_feet(rng, feet, thick)]


def _ties(
    rng: Rng, tops: list[np.ndarray], feet: list[np.ndarray], thick: float
) -> Solids:
    """Bars from leg to leg, all around or in pairs, at one height."""
    if rng.random() < 0.5:
        return []
    level = rng.choice([0.0, rng.uniform(0.2, 0.6)])
    points = [foot + level * (top - foot) for foot, top in zip(feet, tops, strict=True)]
    pairs = list(itertools.pairwise([*points, points[0]]))
    if rng.random() < 0.5:
        pairs = pairs[1::2]
    width = thick * rng.uniform(0.8, 1.6)
    return [bar(start, end, width, width) for start, end in pairs]


def _feet(rng: Rng, feet: list[np.ndarray], thick: float) -> Solids:
    """Pads, balls or wheels under legs, or none."""
    kind, size = rng.random(), thick * rng.uniform(1.5, 4.0)
    if kind < 0.5:
        return []
    if kind < 0.65:
        return [
            rod(foot - 0.3 * size * UP, foot + 0.1 * size * UP, size) for foot in feet
        ]
    if kind < 0.75:
        return [ball(foot, size, 12) for foot in feet]
    axle = np.array([1.2 * thick, 0, 0])
    return [rod(foot - axle, foot + axle, 1.5 * size) for foot in feet]


def pedestal(rng: Rng, body: Manifold) -> Solids:
    """One column on a plate or on a star of feet."""
    middle, sides = extent(body)
    hit = touched(body, middle, UP)
    if hit is None:
        return []
    low = middle[2] - sides[2] / 2 - (sides.max() * np.exp(rng.uniform(-2.0, 0.3)))
    foot = np.array([middle[0], middle[1], low])
    thick = sides.max() * np.exp(rng.uniform(np.log(0.015), np.log(0.12)))
    top = hit.point + min(hit.depth / 2, thick) * UP
    solids = [rod(foot, top, thick, thick * rng.choice([1.0, 0.6]), 16)]
    wide = np.maximum(sides[:2] * rng.uniform(0.4, 1.0), 4 * thick)
    if rng.random() < 0.6:
        plate = block(rng, np.array([*wide, 0.5 * thick + 0.02 * sides.max()]))
        return [*solids, plate.translate(foot)]
    toe = bar((0, 0, thick), (wide.max() / 2, 0, 0.3 * thick), thick, 1.2 * thick, 0.7)
    toes = ring_of(toe, int(rng.integers(3, 6)))
    return [*solids, *(toe.translate(foot) for toe in toes)]


def plinth(rng: Rng, body: Manifold) -> Solids:
    """A block under the body, narrower or wider than it."""
    middle, sides = extent(body)
    hit = touched(body, middle, UP)
    if hit is None:
        return []
    tall = sides.max() * np.exp(rng.uniform(-3.0, -0.3))
    low = middle[2] - sides[2] / 2 - tall
    high = hit.point[2] + min(hit.depth / 2, 0.1 * tall)
    wide = sides[:2] * rng.choice([rng.uniform(0.4, 0.95), rng.uniform(1.0, 1.5)])
    solid = block(rng, np.array([*wide, high - low]))
    return [solid.translate((middle[0], middle[1], (high + low) / 2))]
