"""Farthest-point sampling, and clouds brought to a fixed number of points."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry import kernels
from prism_jax.geometry.extrema import first_true

NEAR_ORIGIN = 1e-3  # squared radius inside which the reference's sampling never looks


def farthest_point_sample(
    points: Float[Array, "N 3"],
    num_samples: int,
    start: int | Int[Array, ""] = 0,
    skip_near_origin: bool = False,
) -> Int[Array, " num_samples"]:
    """Indices of points, each the farthest from those chosen before.

    Begins at ``start``, which must be an index of the cloud; ties go to the lowest
    index; no gradient. A shorter sample is the prefix of a longer one. If there are
    fewer distinct points than samples, the lowest index is repeated. Coordinates must
    be finite; an empty cloud raises ValueError.

    ``skip_near_origin`` is the rule of the reference implementation (PointNet++,
    CRA-PCN): points with ``|x|^2 <= 1e-3`` are never chosen, save as the start, or as
    index 0 when every point is skipped.
    """
    points = jax.lax.stop_gradient(jnp.asarray(points))
    if points.shape[0] == 0:
        raise ValueError("nothing can be sampled from an empty cloud")
    chosen_from = jnp.ones(points.shape[0], bool)
    if skip_near_origin:
        chosen_from = (points**2).sum(-1) > NEAR_ORIGIN
    arrays = points, chosen_from, jnp.asarray(start, jnp.int32)
    search = functools.partial(_farthest_indices, num_samples=num_samples)
    if points.shape[0] > kernels.MAX_FARTHEST_POINTS:
        return search(*arrays)
    kernel = functools.partial(kernels.farthest_indices, num_samples=num_samples)
    return kernels.by_platform(kernel, search, *arrays)


def _farthest_indices(
    points: Array, chosen_from: Array, start: Array, num_samples: int
) -> Array:
    # Coordinate by coordinate; the barrier keeps XLA from slicing anew in each step.
    columns = jax.lax.optimization_barrier(tuple(points[:, i] for i in range(3)))

    def add(carry: tuple[Array, Array], _: None):
        distances, last = carry
        x, y, z = (column - column[last] for column in columns)
        distances = jnp.minimum(distances, x**2 + y**2 + z**2)
        farthest = distances == distances.max(-1, keepdims=True)
        return (distances, first_true(farthest)), last

    # Any first distance is smaller. One of -1 stays.
    unlimited = jnp.asarray(jnp.inf, points.dtype)
    first = (jnp.where(chosen_from, unlimited, -1.0), start)
    return jax.lax.scan(add, first, None, length=num_samples)[1]


def resample(
    points: Float[Array, "N 3"], num_points: int
) -> Float[Array, "num_points 3"]:
    """The cloud with exactly ``num_points`` points, in farthest-point order.

    More points are thinned by farthest-point sampling; fewer are all kept and then
    repeated from the first on. Differentiable in the points that are kept. Drop points
    that are not finite first; an empty cloud raises ValueError.
    """
    points = jnp.asarray(points)
    order = farthest_point_sample(points, min(num_points, points.shape[0]))
    return points[jnp.resize(order, (num_points,))]
