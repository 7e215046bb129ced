"""The lowest, the highest and the k lowest, as a CPU can vectorise them: `argmin`,
`argmax` and `top_k` it does not."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def first_true(marked: Bool[Array, "... N"]) -> Int[Array, "..."]:
    """Index of the first that is marked in the last axis, where one is."""
    last = marked.shape[-1] - 1
    return jnp.where(marked, jnp.arange(last + 1, dtype=jnp.int32), last).min(-1)


def inserted(
    lists: tuple[Sequence[Float[Array, " N"]], Sequence[Int[Array, " N"]]],
    new: Float[Array, " N"],
    index: Int[Array, "..."],
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """N ascending lists with a new value sunk into each: the values and their indices,
    each as the first of all lists, the second of all, and so on.

    What falls off the end is lost. Of equal values the one that came first stays first.
    """
    lower = [new < value for value in lists[0]]

    def sunk(old: Sequence[Array], item: Array) -> tuple[Array, ...]:
        # Each place takes the new entry, keeps its own, or takes the one before it.
        taken = [jnp.where(low, item, own) for low, own in zip(lower, old, strict=True)]
        moved = map(jnp.where, lower[:-1], old[:-1], taken[1:])
        return (taken[0], *moved)

    return sunk(lists[0], new), sunk(lists[1], index)
