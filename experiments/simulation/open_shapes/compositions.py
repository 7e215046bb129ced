"""Random compositions: parts made of parts, each symmetric in its own way."""

import numpy as np
from manifold3d import Manifold

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
)
from experiments.simulation.open_shapes.primitives import (
    Rng,
    Size,
    block,
    primitive,
    prism_of_outline,
)
from experiments.simulation.open_shapes.structures import grid, structure
from experiments.simulation.solids import place, union


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
        return largest_piece(grid(rng, size, _shallow, 6))
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


def _shallow(rng: Rng, size: Size) -> Manifold:
    return composite(rng, size, 0)


def sides(rng: Rng, longest: float) -> Size:
    """A box's sides, the longest of them given, the others down to a fifth of it."""
    shares = np.exp(rng.uniform(np.log(0.2), 0.0, 3))
    return longest * shares / shares.max()
