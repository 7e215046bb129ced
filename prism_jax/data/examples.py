"""One example: a shape, its complete cloud, one partial view, in stored form.

Frame: the bounding box of the 16,384-point complete cloud is centred at the origin and
the box's longest side spans [-1, 1]. This oracle frame is for storage; a network's
workspace is taken from the partial alone, later. Coordinates are int16 multiples of
`QUANTUM`, exact in float32, up to +-2.
"""

import numpy as np
import trimesh
from jaxtyping import Float, Float32, Int16

from prism_jax.data.partials import (
    farthest_point_order,
    random_viewpoint,
    self_occlusion,
)
from prism_jax.data.raycast import Scene
from prism_jax.data.shapes import category_rng, make_shape

QUANTUM = 2.0**-14
SURFACE_POINTS = 16384
PARTIAL_POINTS = 2048


def quantise(points: Float[np.ndarray, "*shape 3"]) -> Int16[np.ndarray, "*shape 3"]:
    """Nearest multiples of `QUANTUM`; coordinates beyond +-1.99 raise ValueError."""
    if not np.all(np.abs(points) < 1.99):
        raise ValueError("coordinates must be finite and within +-1.99")
    return np.round(points / QUANTUM).astype(np.int16)


def dequantise(
    points: Int16[np.ndarray, "*shape 3"],
) -> Float32[np.ndarray, "*shape 3"]:
    """Coordinates in the example's frame of stored points."""
    return points.astype(np.float32) * np.float32(QUANTUM)


def make_example(
    category: str, seed: int, complete_points: int = SURFACE_POINTS
) -> tuple[
    Int16[np.ndarray, "2048 3"],
    Int16[np.ndarray, "C 3"],
    Float32[np.ndarray, "3"],
]:
    """Partial cloud, complete cloud and viewpoint: a pure function of its arguments.

    Both clouds are in farthest-point order; a partial of fewer than 2,048 distinct
    points is repeated cyclically.
    """
    rng = category_rng(category, seed, 1)
    mesh = make_shape(category, seed)
    surface = np.asarray(
        trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=rng)[0]
    )
    lower, upper = surface.min(axis=0), surface.max(axis=0)
    center, half = (lower + upper) / 2, (upper - lower).max() / 2
    mesh.vertices = (mesh.vertices - center) / half
    viewpoint = random_viewpoint(rng)
    hits = self_occlusion(Scene(mesh), viewpoint, PARTIAL_POINTS)
    complete = farthest_point_order((surface - center) / half, complete_points)
    partial = farthest_point_order(hits, PARTIAL_POINTS)
    return quantise(partial), quantise(complete), viewpoint.astype(np.float32)
