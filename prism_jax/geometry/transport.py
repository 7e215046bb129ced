"""Entropic optimal transport by Sinkhorn's iterations in the log domain."""

import jax
import jax.numpy as jnp
from jax.nn import logsumexp
from jaxtyping import Array, Float


def sinkhorn(
    cost: Float[Array, "M N"],
    epsilon: float | Float[Array, ""],
    num_iterations: int = 50,
) -> tuple[Float[Array, "M N"], Float[Array, ""]]:
    """The entropic transport plan and its cost ``<plan, cost>`` (PRISM, Eq. 8).

    ``epsilon`` is in the cost's units and must be positive; a small one needs more
    iterations. Both marginals are uniform and sum to 1: the plan's columns after any
    number of iterations, its rows in the limit. Differentiable to any order in ``cost``
    and ``epsilon``, by unrolled iterations. The returned cost has no entropy term.

    M. Cuturi, "Sinkhorn distances", NeurIPS 2013; log domain: G. Peyre, M. Cuturi,
    "Computational optimal transport", 2019, section 4.4.
    """
    num_rows, num_columns = cost.shape
    log_a = jnp.full(num_rows, -jnp.log(num_rows)).astype(cost.dtype)
    log_b = jnp.full(num_columns, -jnp.log(num_columns)).astype(cost.dtype)
    log_kernel = -cost / epsilon

    def iterate(log_v, _):
        log_u = log_a - logsumexp(log_kernel + log_v[None, :], axis=1)
        log_v = log_b - logsumexp(log_kernel + log_u[:, None], axis=0)
        return log_v, log_u

    log_v, log_us = jax.lax.scan(iterate, jnp.zeros_like(log_b), length=num_iterations)
    plan = jnp.exp(log_kernel + log_us[-1][:, None] + log_v[None, :])
    return plan, jnp.sum(plan * cost)
