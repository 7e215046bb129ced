"""Clouds in farthest-point order, every prefix of which is a farthest-point sample."""

import numpy as np
from jaxtyping import Float

from prism_jax.io.errors import require

BUCKET_LEVELS = 5
"""Levels of the search tree of the bucketed farthest-point search: speed only."""


def farthest_point_order(
    points: Float[np.ndarray, "N 3"], num_points: int
) -> Float[np.ndarray, "M 3"]:
    """The first `num_points` points in exact farthest-point order, repeated if there
    are fewer. The first point is arbitrary, but the same for the same cloud. An empty
    cloud raises ValueError; without fpsample this raises InputError."""
    fpsample = require("fpsample", "data")
    if len(points) == 0:
        raise ValueError("cannot sample an empty cloud")
    distinct = min(num_points, len(points))
    coordinates = np.ascontiguousarray(points, np.float32)
    if len(points) < 1 << BUCKET_LEVELS:
        order = fpsample.fps_sampling(coordinates, distinct, start_idx=0)
    else:
        order = fpsample.bucket_fps_kdline_sampling(
            coordinates, distinct, h=BUCKET_LEVELS, start_idx=0
        )
    return points[np.resize(order.astype(np.int64), num_points)]


def first_points(
    cloud: Float[np.ndarray, "N 3"], count: int, ordered: bool
) -> Float[np.ndarray, "M 3"]:
    """`count` farthest points, repeated if there are fewer; a prefix if `ordered`."""
    if not ordered:
        return farthest_point_order(cloud, count)
    return cloud[:count] if count <= len(cloud) else np.resize(cloud, (count, 3))
