"""Several sources as one, each with its share of the items."""

import math
import os
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from experiments.splits import Subset, training_split, validation_rows
from prism_jax.data.datasets import DATASETS, open_dataset
from prism_jax.data.shards import Shards
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
    weights: Mapping[str, float | int],
    data_dir: str | os.PathLike | None = None,
    num_validation: int = 200,
    whole: float | None = None,
) -> tuple[Mixture, Mixture]:
    """What to train on, and `num_validation` examples of each set to validate with.

    `whole` is the share of views that show the whole object (`Shards.whole`) in each
    set that has both such and others; None draws views as they come. Sets without a
    validation split of their own are trained on alone; that none has one raises
    InputError, as `open_dataset` does.
    """
    train, shares, validation = [], [], []
    for name, weight in weights.items():
        choose("data set", name, DATASETS)
        source = open_dataset(name, training_split(name), data_dir)
        for part, share in parts_of(source, whole):
            train.append(part)
            shares.append(weight * share)
        if DATASETS[name].validation is not None:
            validation.append(validation_rows(name, data_dir, num_validation))
    if not validation:
        fault = "has no set with a validation split of its own"
        raise InputError("--mixture", fault, "add shapes")
    sizes = [len(source) for source in validation]
    return Mixture(train, shares), Mixture(validation, sizes)


def parts_of(source: Source, whole: float | None) -> list[tuple[Source, float]]:
    """A source with its share of one, or its whole views and its others with theirs."""
    if whole is None or not isinstance(source, Shards):
        return [(source, 1.0)]
    shows = source.whole
    if shows.all() or not shows.any():
        return [(source, 1.0)]
    rows = (np.flatnonzero(shows), whole), (np.flatnonzero(~shows), 1.0 - whole)
    return [(Subset(source, part), share) for part, share in rows if share > 0]
