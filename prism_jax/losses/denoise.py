"""Denoising objective, Eq. 6: the perturbation A, the target U and the loss."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from prism_jax.geometry.neighbors import knn
from prism_jax.losses.chamfer import chamfer


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

    `jitter` is the standard deviation of isotropic noise in the unit of the points;
    `range_noise` that along the ray from `origin`, the sensor's position in the points'
    frame, as a fraction of the range. A farther origin counts as `max_distance` from
    the frame's own: no sensor of the validation sets is over 9 units away, and noise of
    one at 1,000 would bury the cloud. `drop` is the fraction of points lost: their
    rows hold copies of kept points, of which there is at least one. Differentiable in
    `points` and `origin`. `drop` outside [0, 1] raises `ValueError`.
    """
    if not 0.0 <= drop <= 1.0:
        raise ValueError(f"drop must be a fraction in [0, 1], not {drop}")
    origin = jnp.asarray(origin)
    squared = jnp.sum(origin**2)
    too_far = squared > max_distance**2
    # Of a near one no root is taken: its gradient at zero is infinite.
    distance = jnp.sqrt(jnp.where(too_far, squared, 1.0))
    origin = jnp.where(too_far, max_distance * (origin / distance), origin)
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


def upsample_midpoints(
    points: Float[Array, "N 3"], num_candidates: int = 8
) -> Float[Array, "2*N 3"]:
    """U(P) of Eq. 6: the points, then their midpoints to the nearest other point.

    Partial clouds repeat points to reach a fixed count, so copies of a point are passed
    over: the neighbour is the nearest one apart from it among `num_candidates`, or the
    point itself if all are copies. Differentiable in the points.
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
) -> Float[Array, ""]:
    """Eq. 6: Chamfer distance of P^dn, the perturbed input plus `offsets`, to U(P), and
    the mean squared offset. Differentiable in all three; faults as in `chamfer`."""
    offset_penalty = jnp.mean(jnp.sum(offsets**2, axis=-1))
    return chamfer(denoised, target) + lambda_offset * offset_penalty
