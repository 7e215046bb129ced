"""The auxiliary losses' names, and their weighting, Eq. 11."""

from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Branch = Literal["normal", "denoise", "align"]

BRANCHES: tuple[Branch, ...] = get_args(Branch)
"""The auxiliary losses, Eq. 5, 6 and 9, in the order of their weights."""


def update_scale(
    scale: Float[Array, " K"], values: Float[Array, " K"], decay: float = 0.99
) -> Float[Array, " K"]:
    """Moving average of the losses' own values, by which Eq. 11 normalises them. A
    scale of zero is not measured yet, and takes the value as it is."""
    average = decay * scale + (1.0 - decay) * values
    return jax.lax.stop_gradient(jnp.where(scale > 0, average, values))


def weighted_auxiliary(
    logits: Float[Array, " K"], losses: Float[Array, " K"], scales: Float[Array, " K"]
) -> Float[Array, ""]:
    """Eq. 11: the sum of the losses, weighted by softmax(logits), each divided by its
    scale, unless that is zero, not measured yet. Differentiable in `logits` and
    `losses`."""
    scales = jax.lax.stop_gradient(jnp.where(scales > 0, scales, 1.0))
    return jnp.sum(jax.nn.softmax(logits) * losses / scales)
