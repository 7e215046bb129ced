"""The learned term: from a point's geometry to the logarithm of its error.

It is fitted on completions of objects whose truth is known (`experiments.learned_term`)
and lies under ``params`` as `LEARNED`, in weights that have it.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from prism_jax.losses.learned import MIDDLE, NAMES
from prism_jax.models.layers import Dense
from prism_jax.models.variables import Variables, apply

LEARNED = "learned"
"""Its name among the parameters."""

HIDDEN = (64, 64)
"""Widths of the hidden layers."""


class ErrorHead(nn.Module):
    """Two hidden layers over `prism_jax.losses.learned.NAMES`, smooth, so that its
    gradient says something everywhere and can be differentiated again."""

    @nn.compact
    def __call__(self, clues: Float[Array, "... N C"]) -> Float[Array, "... N"]:
        x = clues
        for i, width in enumerate(HIDDEN):
            x = nn.silu(Dense(width, name=f"dense_{i}")(x))
        return Dense(1, name=f"dense_{len(HIDDEN)}")(x)[..., 0] + MIDDLE


def init_error_head(key: PRNGKeyArray) -> Variables:
    """Fresh parameters."""
    return ErrorHead().init(key, jnp.zeros((1, len(NAMES))))["params"]


def log_errors(
    params: Variables, clues: Float[Array, "... N C"]
) -> Float[Array, "... N"]:
    """The logarithm of each point's expected distance from the true surface, in half
    sides of the workspace. Differentiable in both."""
    return apply(ErrorHead(), {"params": params}, clues)


def with_term(variables: Variables, params: Variables) -> Variables:
    """The variables with this term in the place of theirs."""
    return {**variables, "params": {**variables["params"], LEARNED: params}}


def term_shapes() -> Variables:
    """The shapes of the parameters; no memory is taken."""
    return jax.eval_shape(lambda: init_error_head(jax.random.key(0)))
