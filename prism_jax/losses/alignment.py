"""Alignment of 3D and depth features, Eq. 7-9."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.geometry.precision import exact_products
from prism_jax.geometry.transport import sinkhorn

# Below this mean cost the tokens coincide and any plan will do.
MIN_MEAN_COST = 1e-12


def manifold_matching(
    tokens_3d: Float[Array, "m d"],
    tokens_depth: Float[Array, "n d"],
    lambda_sigma: float = 1.0,
) -> Float[Array, ""]:
    """Eq. 7: squared differences of the means and of the covariances.

    Statistics are taken over the rows: the tokens of one frame while adapting, or those
    of a whole batch. One token has a covariance of zero. Differentiable in both.
    """
    mean_3d, covariance_3d = _mean_and_covariance(tokens_3d)
    mean_depth, covariance_depth = _mean_and_covariance(tokens_depth)
    first_order = jnp.sum((mean_3d - mean_depth) ** 2)
    second_order = jnp.sum((covariance_3d - covariance_depth) ** 2)
    return first_order + lambda_sigma * second_order


def transport_alignment(
    tokens_3d: Float[Array, "m d"],
    tokens_depth: Float[Array, "n d"],
    epsilon_relative: float = 0.05,
    num_iterations: int = 30,
) -> Float[Array, ""]:
    """Eq. 8: cost of the entropic transport plan between the two token sets.

    The cost is the squared distance; the regularisation is `epsilon_relative` times the
    mean cost, without a gradient. Differentiable in both, through the plan as well.
    Equal sets do not give zero: the plan is blurred.
    """
    cost = _squared_distances(tokens_3d, tokens_depth)
    mean_cost = jnp.maximum(jax.lax.stop_gradient(jnp.mean(cost)), MIN_MEAN_COST)
    # Scaling the cost and not epsilon keeps the solver's numbers near one.
    _, relative_cost = sinkhorn(cost / mean_cost, epsilon_relative, num_iterations)
    return mean_cost * relative_cost


def alignment_loss(
    tokens_3d: Float[Array, "m d"],
    tokens_depth: Float[Array, "n d"],
    lambda_sigma: float = 1.0,
    lambda_ot: float = 1.0,
    epsilon_relative: float = 0.05,
) -> Float[Array, ""]:
    """Eq. 9: `manifold_matching` plus `lambda_ot` times `transport_alignment`."""
    matching = manifold_matching(tokens_3d, tokens_depth, lambda_sigma)
    transport = transport_alignment(tokens_3d, tokens_depth, epsilon_relative)
    return matching + lambda_ot * transport


@exact_products
def _mean_and_covariance(
    tokens: Float[Array, "n d"],
) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    mean = jnp.mean(tokens, axis=0)
    centred = tokens - mean
    covariance = centred.T @ centred / tokens.shape[0]
    return mean, covariance


@exact_products
def _squared_distances(
    a: Float[Array, "m d"], b: Float[Array, "n d"]
) -> Float[Array, "m n"]:
    """Without the m x n x d array of differences, and centred, against cancellation."""
    center = jax.lax.stop_gradient(jnp.mean(jnp.concatenate([a, b]), axis=0))
    a, b = a - center, b - center
    squares = jnp.sum(a**2, axis=-1)[:, None] + jnp.sum(b**2, axis=-1)
    return jnp.maximum(squares - 2.0 * (a @ b.T), 0.0)
