"""Random primitives: one simple solid in a box."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from manifold3d import CrossSection, Manifold

from experiments.simulation.open_shapes.outlines import (
    circle,
    convex_outline,
    outline,
    path,
    profile,
    smooth,
    tightest_bend,
)
from experiments.simulation.solids import (
    ball,
    box,
    capsule,
    lathe,
    place,
    slab,
    sweep,
    torus,
)

Rng = np.random.Generator
Size = Float64[np.ndarray, "3"]
Make = Callable[[Rng, Size], Manifold]


def primitive(rng: Rng, size: Size) -> Manifold:
    """One of `PRIMITIVES`."""
    return PRIMITIVES[rng.choice(len(PRIMITIVES), p=_WEIGHTS)](rng, size)


def block(rng: Rng, size: Size) -> Manifold:
    """What is convex, and flat below and above: a box, prism, frustum or loft."""
    kinds = (cuboid, convex_prism, frustum, loft_of_outlines)
    return kinds[rng.choice(4, p=(0.4, 0.15, 0.35, 0.1))](rng, size)


def fitted(solid: Manifold, size: Size) -> Manifold:
    """The solid moved and stretched until its box is that of the size."""
    lower, upper = np.array(solid.bounding_box()).reshape(2, 3)
    return solid.translate(-(lower + upper) / 2).scale(size / (upper - lower))


def even(rng: Rng, size: Size, share: float = 0.8) -> Size:
    """The size with its sides along x and y alike, as round things mostly have."""
    side = size[:2].min() if rng.random() < share else size[:2]
    return np.array([*np.broadcast_to(side, 2), size[2]])


def any_axis(make: Make) -> Make:
    """Builds along z what `make` does, or as often along x or y."""

    def along_any(rng: Rng, size: Size) -> Manifold:
        turn = int(rng.choice([0, 0, 1, 2]))
        axes = np.roll(np.eye(3), turn, axis=1)
        return place(make(rng, np.roll(size, turn)), axes, np.zeros(3))

    return along_any


def cuboid(rng: Rng, size: Size) -> Manifold:
    """A box, its edges cut in some."""
    chamfer = rng.uniform(0.03, 0.3) * size.min() if rng.random() < 0.35 else 0.0
    return box((0, 0, 0), size, chamfer)


def convex_prism(rng: Rng, size: Size) -> Manifold:
    """A convex outline drawn upwards."""
    return fitted(CrossSection([convex_outline(rng)]).extrude(1.0), size)


def prism_of_outline(rng: Rng, size: Size) -> Manifold:
    """A random outline drawn upwards, tapered or twisted in some."""
    style, top, twist, steps = rng.random(), (1.0, 1.0), 0.0, 0
    if style < 0.2:
        top = tuple(rng.uniform(0.4, 0.9, 2))
    elif style < 0.27:
        twist, steps = rng.uniform(-120, 120), 6
    return fitted(CrossSection([outline(rng)]).extrude(1.0, steps, twist, top), size)


def frustum(rng: Rng, size: Size) -> Manifold:
    """A cylinder, or part of a cone either way up."""
    top = 1.0 if rng.random() < 0.55 else rng.uniform(0.05, 0.9)
    solid = Manifold.cylinder(1.0, 1.0, top, int(rng.choice([12, 20, 28])))
    if rng.random() < 0.3:
        solid = solid.mirror((0, 0, 1))
    return fitted(solid, even(rng, size))


def loft_of_outlines(rng: Rng, size: Size) -> Manifold:
    """The hull of two convex outlines, one above the other: hoppers, roofs, wedges."""
    scale, shift = rng.uniform(0.1, 1.0, 2), rng.choice([0.0, 0.5]) * rng.uniform(-1, 1)
    upper = convex_outline(rng) * scale + (0, shift * (1 - scale[1]))
    lower = convex_outline(rng)
    rows = [np.column_stack([lower, 0 * lower[:, 0]])]
    rows.append(np.column_stack([upper, 0 * upper[:, 0] + 1]))
    return fitted(Manifold.hull_points(np.concatenate(rows)), size)


def ellipsoid(rng: Rng, size: Size) -> Manifold:
    """An ellipsoid, or what a plane leaves of it."""
    solid = ball((0, 0, 0), 1.0, 16)
    if rng.random() < 0.4:
        solid = solid.trim_by_plane((0, 0, 1), rng.uniform(-0.7, 0.5))
    return fitted(solid, even(rng, size))


def ring(rng: Rng, size: Size) -> Manifold:
    """A torus or part of one, its section round or angular."""
    thick = np.exp(rng.uniform(np.log(0.08), np.log(0.45)))
    degrees = 360.0 if rng.random() < 0.7 else rng.uniform(90, 300)
    solid = torus(1.0, thick, degrees, 20, int(rng.choice([4, 8])))
    width = size[:2].min()
    tall = rng.uniform(1.0, 2.0) * thick / (1 + thick) * width
    return fitted(solid, np.array([width, width, min(size[2], tall)]))


def pill(rng: Rng, size: Size) -> Manifold:
    """A capsule along z, its ends of two sizes in some."""
    radius = min(size[0], size[1], 0.9 * size[2]) / 2
    other = radius * (1.0 if rng.random() < 0.6 else rng.uniform(0.3, 0.9))
    low, high = -size[2] / 2 + radius, size[2] / 2 - other
    return capsule((0, 0, low), (0, 0, high), radius, other, 12)


def turned(rng: Rng, size: Size) -> Manifold:
    """A random profile turned about z."""
    return fitted(lathe(list(profile(rng)), 20), even(rng, size, 0.9))


def pipe_along(
    line: Float64[np.ndarray, "P 3"], radius: float, segments: int = 8
) -> Manifold:
    """A round section along a way, thinner where the way bends tightly."""
    return sweep(line, within_bends(radius, line) * circle(segments))


def within_bends(radius: float, line: Float64[np.ndarray, "P 3"]) -> float:
    """A radius within a way's tightest bend, but no less than half of it."""
    return max(min(radius, 0.8 * tightest_bend(line)), radius / 2)


def pipe_along_path(rng: Rng, size: Size) -> Manifold:
    """A round or angular section, even or tapered, along a smooth path."""
    way = path(rng)
    radius = size.max() * np.exp(rng.uniform(np.log(0.02), np.log(0.1)))
    line = way * np.maximum(size - 2 * radius, 0.3 * size)
    radius = within_bends(radius, line)
    section = circle(8) if rng.random() < 0.7 else 0.8 * circle(4, np.pi / 4)
    scales = None
    if rng.random() < 0.25:
        scales = np.linspace(1.0, rng.uniform(0.3, 0.8), len(line))
    return sweep(line, radius * section, scales)


def bent_plate(rng: Rng, size: Size) -> Manifold:
    """A flat strip bent about the x axis: brackets, channels, waves, hooks."""
    count = int(rng.integers(3, 6))
    corners = np.column_stack([rng.uniform(-0.5, 0.5, count), np.arange(count)])
    if rng.random() < 0.5:
        corners = np.array([(0.0, 0.0), (rng.uniform(-1, 1), 1.0), (1.0, 1.0)])
    line = smooth(corners, int(rng.choice([0, 2, 3])))
    line = (line - line.min(axis=0)) / np.maximum(np.ptp(line, axis=0), 1e-3) - 0.5
    way = np.column_stack([0 * line[:, 0], line * size[1:]])
    thick = size.max() * np.exp(rng.uniform(np.log(0.012), np.log(0.06)))
    thick = min(thick, tightest_bend(way))
    strip = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    return sweep(way, strip * (size[0], thick))


def dished_plate(rng: Rng, size: Size) -> Manifold:
    """A plate curved two ways: seats, blades, dishes, saddles."""
    u, v = np.meshgrid(*[np.linspace(-1, 1, 8)] * 2, indexing="ij")
    bend, other = rng.uniform(-1, 1, 2)
    height = bend * u**2 + other * v**2 + rng.choice([0.0, 0.5]) * u * v
    x, y = u * (1 - rng.choice([0.0, 0.35]) * (1 + v) / 2), v
    if rng.random() < 0.3:
        x, y = u * np.sqrt(1 - v**2 / 2), v * np.sqrt(1 - u**2 / 2)
    tall = min(size[2], 0.5 * size[:2].max())
    height *= tall / max(np.ptp(height), 1e-3)
    thick = size[:2].max() * np.exp(rng.uniform(np.log(0.015), np.log(0.06)))
    middle = np.stack([x * size[0] / 2, y * size[1] / 2, height], axis=-1)
    solid = slab(middle + (0, 0, thick / 2), middle - (0, 0, thick / 2))
    return fitted(solid, np.array([*size[:2], tall + thick]))


def relief(rng: Rng, size: Size) -> Manifold:
    """A block under a field of heights: waves, bumps, or terraces of them."""
    count = int(rng.integers(7, 11))
    u, v = np.meshgrid(*[np.linspace(-1, 1, count)] * 2, indexing="ij")
    height = np.zeros_like(u)
    for _ in range(int(rng.integers(1, 5))):
        x, y = rng.uniform(-0.9, 0.9, 2)
        bump = np.exp(-((u - x) ** 2 + (v - y) ** 2) / rng.uniform(0.15, 0.6) ** 2)
        height += rng.uniform(-0.4, 1.0) * bump
    if rng.random() < 0.4:
        height = rng.uniform(0.3, 1.0) * np.cos(rng.uniform(2, 7) * u) + 0.3 * height
    if rng.random() < 0.25:
        height = np.round(height * 3) / 3
    height = (height - height.min()) / max(np.ptp(height), 1e-3)
    base = rng.uniform(0.1, 0.5)
    upper = np.stack([u, v, base + (1 - base) * height], axis=-1)
    solid = slab(upper, np.stack([u, v, 0 * u], axis=-1))
    return fitted(solid, np.minimum(size, (*size[:2], 0.7 * size[:2].min())))


def stone(rng: Rng, size: Size) -> Manifold:
    """The hull of a few points, the same on its left and right."""
    points = rng.normal(size=(int(rng.integers(5, 10)), 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True) ** rng.uniform(0.3, 1.0)
    both = np.concatenate([points, points * (-1, 1, 1)])
    return fitted(Manifold.hull_points(both), size)


_UPRIGHT: dict[Make, float] = {
    cuboid: 0.2,
    ellipsoid: 0.06,
    bent_plate: 0.06,
    dished_plate: 0.05,
    relief: 0.03,
    stone: 0.03,
}
_ANY_AXIS: dict[Make, float] = {
    prism_of_outline: 0.17,
    frustum: 0.15,
    turned: 0.08,
    loft_of_outlines: 0.05,
    ring: 0.03,
    pill: 0.04,
    pipe_along_path: 0.05,
}


PRIMITIVES: tuple[Make, ...] = (*_UPRIGHT, *map(any_axis, _ANY_AXIS))
_WEIGHTS = np.array([*_UPRIGHT.values(), *_ANY_AXIS.values()])
_WEIGHTS /= _WEIGHTS.sum()
