"""`argmin` and `argmax` as two plain reductions, which a CPU vectorises as it does
not those."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def first_lowest(values: Float[Array, "... N"]) -> Int[Array, "..."]:
    """Index of the lowest value of the last axis, the first of several.

    Values must not be NaN.
    """
    return _first(values == values.min(-1, keepdims=True))


def first_highest(values: Float[Array, "... N"]) -> Int[Array, "..."]:
    """Index of the highest value of the last axis, the first of several.

    Values must not be NaN.
    """
    return _first(values == values.max(-1, keepdims=True))


def _first(chosen: Array) -> Array:
    last = chosen.shape[-1] - 1
    return jnp.where(chosen, jnp.arange(last + 1, dtype=jnp.int32), last).min(-1)
