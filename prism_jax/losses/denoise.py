"""Denoising objective, Eq. 6: the perturbation A, the target U and the loss."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from prism_jax.geometry.neighbors import knn
from prism_jax.losses.chamfer import ChamferNorm, chamfer


def perturb(
    key: PRNGKeyArray,
    points: Float[Array, "N 3"],
    origin: Float[Array | np.ndarray, "3"],
    jitter: float = 0.01,
    drop: float = 0.1,
    range_noise: float = 0.005,
    max_distance: float = 16.0,
) -> Float[Array, "N 3"]:
    """A(P) of Eq. 6: jitter, range noise and random drop of a partial cloud.

    `jitter` is the standard deviation of isotropic noise in the unit of the
    points. `range_noise` is the standard deviation of the noise along the ray from
    `origin`, the sensor's position in the points' frame, as a fraction of the
    range. An origin farther than `max_distance` from the frame's own counts as being
    that far: in the validation sets no sensor stands over 9 units from the middle of
    the workspace, and the noise of one at 1,000 would bury the cloud. `drop` is the
    fraction of points lost: their rows hold copies of kept points, so that the shape
    stays; at least one point is kept. Differentiable in `points` and `origin`. `drop`
    outside [0, 1] raises `ValueError`.
    """
    if not 0.0 <= drop <= 1.0:
        raise ValueError(f"drop must be a fraction in [0, 1], not {drop}")
    origin = _brought_near(jnp.asarray(origin), max_distance)
    jitter_key, range_key, drop_key, copy_key = jax.random.split(key, 4)
    count = points.shape[0]
    noise = jitter * jax.random.normal(jitter_key, points.shape, points.dtype)
    along = range_noise * jax.random.normal(range_key, (count, 1), points.dtype)
    noisy = points + noise + along * (points - origin)

    num_kept = max(1, round(count * (1.0 - drop)))
    order = jax.random.permutation(drop_key, count)
    kept, dropped = order[:num_kept], order[num_kept:]
    copies = kept[jax.random.randint(copy_key, dropped.shape, 0, num_kept)]
    return noisy.at[dropped].set(noisy[copies])


def _brought_near(origin: Float[Array, "3"], farthest: float) -> Float[Array, "3"]:
    """A place as it is, or in the same direction at the distance `farthest`."""
    squared = jnp.sum(origin**2)
    too_far = squared > farthest**2
    # Of a near one no root is taken: its gradient at zero is infinite.
    distance = jnp.sqrt(jnp.where(too_far, squared, 1.0))
    return jnp.where(too_far, farthest * (origin / distance), origin)


def upsample_midpoints(
    points: Float[Array, "N 3"], num_candidates: int = 8
) -> Float[Array, "2*N 3"]:
    """U(P) of Eq. 6: the points, then their midpoints to the nearest other point.

    Partial clouds repeat points to reach a fixed count, so copies of a point are
    passed over: the neighbour is the nearest one apart from it among
    `num_candidates`. A point whose candidates are all copies is its own midpoint.
    Differentiable in the points for the neighbours found.
    """
    count = points.shape[0]
    candidates = knn(points, points, min(num_candidates, count))
    apart = jnp.any(points[candidates] != points[:, None], axis=-1)
    first = jnp.argmax(apart, axis=-1)
    neighbor = jnp.take_along_axis(candidates, first[:, None], axis=-1)[:, 0]
    neighbor = jnp.where(jnp.any(apart, axis=-1), neighbor, jnp.arange(count))
    return jnp.concatenate([points, 0.5 * (points + points[neighbor])])


def denoise_loss(
    denoised: Float[Array, "N 3"],
    target: Float[Array, "M 3"],
    offsets: Float[Array, "N 3"],
    lambda_offset: float = 0.1,
    norm: ChamferNorm = "l2",
) -> Float[Array, ""]:
    """Eq. 6: Chamfer distance of P^dn to U(P), and the mean squared offset.

    `denoised` is the perturbed input plus `offsets`, `target` is U(P), all in one
    frame. Differentiable in all three; faults as in `chamfer`.
    """
    offset_penalty = jnp.mean(jnp.sum(offsets**2, axis=-1))
    return chamfer(denoised, target, norm) + lambda_offset * offset_penalty
