"""Random shells: thin walls around a hollow that is open on a side, in a box."""

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold

from experiments.simulation.open_shapes.frames import thickness
from experiments.simulation.open_shapes.outlines import outline, profile
from experiments.simulation.open_shapes.primitives import (
    Make,
    Rng,
    Size,
    cuboid,
    even,
    frustum,
    loft_of_outlines,
)


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
