"""The lowest, the highest and the k lowest, as a CPU can vectorise them: `argmin`,
`argmax` and `top_k` it does not."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def first_lowest(values: Float[Array, "... N"]) -> Int[Array, "..."]:
    """Index of the lowest value of the last axis, the first of several; no NaN."""
    return _first(values == values.min(-1, keepdims=True))


def first_highest(values: Float[Array, "... N"]) -> Int[Array, "..."]:
    """Index of the highest value of the last axis, the first of several; no NaN."""
    return _first(values == values.max(-1, keepdims=True))


def _first(chosen: Array) -> Array:
    last = chosen.shape[-1] - 1
    return jnp.where(chosen, jnp.arange(last + 1, dtype=jnp.int32), last).min(-1)


def inserted(
    lists: tuple[Sequence[Float[Array, " N"]], Sequence[Int[Array, " N"]]],
    new: Float[Array, " N"],
    index: Int[Array, "..."],
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """N ascending lists with a new value sunk into each: the values and their indices,
    each as the first of all lists, the second of all, and so on.

    What falls off the end is lost. Of equal values the one that came first stays first.
    """
    values, indices = lists
    lower = [new < value for value in values]
    # Each place takes the new entry, keeps its own, or takes the one before it.
    entries = [
        (jnp.where(low, new, value), jnp.where(low, index, old))
        for low, value, old in zip(lower, values, indices, strict=True)
    ]
    for i in range(1, len(values)):
        moves, (value, old) = lower[i - 1], entries[i]
        entries[i] = (
            jnp.where(moves, values[i - 1], value),
            jnp.where(moves, indices[i - 1], old),
        )
    found, places = zip(*entries, strict=True)
    return found, places
