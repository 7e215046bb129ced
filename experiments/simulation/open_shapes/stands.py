"""Random stands: what a body stands on, from its underside down to the floor."""

import itertools

import numpy as np
from manifold3d import Manifold

from experiments.simulation.open_shapes.attachments import extent, touched
from experiments.simulation.open_shapes.outlines import circle
from experiments.simulation.open_shapes.primitives import Rng, block
from experiments.simulation.solids import ball, bar, ring_of, rod

UP = np.array([0.0, 0.0, 1.0])


def stand(rng: Rng, body: Manifold) -> list[Manifold]:
    """Legs, a pedestal or a plinth; nothing where they find no hold."""
    kind = (legs, pedestal, plinth)[rng.choice(3, p=(0.6, 0.2, 0.2))]
    return kind(rng, body)


def legs(rng: Rng, body: Manifold) -> list[Manifold]:
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
) -> list[Manifold]:
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


def _feet(rng: Rng, feet: list[np.ndarray], thick: float) -> list[Manifold]:
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


def pedestal(rng: Rng, body: Manifold) -> list[Manifold]:
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


def plinth(rng: Rng, body: Manifold) -> list[Manifold]:
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
