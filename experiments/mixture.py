"""Several sources as one, each with its share of the items."""

import math
import os
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from experiments.splits import training_split
from prism_jax.data.datasets import DATASETS, open_dataset
from prism_jax.data.source import Example, Source
from prism_jax.io.errors import InputError, choose

MAX_WEIGHT = 1e6


class Mixture:
    """Items of several sources, by weights that say how often each is seen.

    It is as long as it takes until every item of every source comes once. Items of a
    source whose weight is more than its size calls for come again, all of them as
    often, but for one. The items of a source follow one another in its own order:
    whoever trains shuffles them.
    """

    def __init__(self, sources: Sequence[Source], weights: Sequence[float | int]):
        self._sources = list(sources)
        self.categories = tuple(
            dict.fromkeys(c for source in sources for c in source.categories)
        )
        sizes = np.array([len(source) for source in sources])
        shares = np.asarray(weights, np.float64) / np.sum(weights)
        length = (sizes / shares).max()
        counts = np.maximum(np.rint(shares * length).astype(int), sizes)
        self._counts, self._starts = counts, np.cumsum([0, *counts])
        firsts = np.cumsum([0, *(source.objects.max() + 1 for source in sources)])
        self.objects: Int[np.ndarray, " N"] = np.concatenate(
            [
                source.objects[self._rows(number)] + first
                for number, (source, first) in enumerate(
                    zip(sources, firsts, strict=False)
                )
            ]
        )

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> Example:
        index = range(len(self))[index]
        number = int(np.searchsorted(self._starts, index, "right")) - 1
        place = index - int(self._starts[number])
        source = self._sources[number]
        return source[place * len(source) // int(self._counts[number])]

    def _rows(self, number: int) -> Int[np.ndarray, " M"]:
        count = int(self._counts[number])
        return np.arange(count) * len(self._sources[number]) // count

    @property
    def shares(self) -> Float[np.ndarray, " S"]:
        """Of the items, by source."""
        return self._counts / self._counts.sum()


def parse_mixture(text: str) -> dict[str, float]:
    """Data sets and their weights, from `shapes:1,open:2`; a weight of 1 can be left
    out. Anything else raises InputError."""
    remedy = "write shapes:1,open:2"
    weights: dict[str, float] = {}
    for part in text.split(","):
        name, _, weight = part.partition(":")
        try:
            value = float(weight) if weight else 1.0
        except ValueError:
            value = math.nan
        if not name or not 0 < value <= MAX_WEIGHT:
            fault = f"{part!r} is not a data set with a weight"
            raise InputError("--mixture", fault, remedy)
        if name in weights:
            raise InputError("--mixture", f"{name} is listed twice", remedy)
        weights[name] = value
    return weights


def open_mixture(
    weights: Mapping[str, float | int], data_dir: str | os.PathLike | None = None
) -> Mixture:
    """What to train on; InputError if a set cannot be, or as `open_dataset` raises."""
    for name in weights:
        choose("data set", name, DATASETS)
    sources = [open_dataset(name, training_split(name), data_dir) for name in weights]
    return Mixture(sources, [*weights.values()])
