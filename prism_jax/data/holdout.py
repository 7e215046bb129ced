"""Objects that a training never sees, held out with all their views."""

import numpy as np

from prism_jax.data.source import Example, Source
from prism_jax.io.errors import InputError


class Subset:
    """Some items of a source, in the order of `rows`."""

    def __init__(self, source: Source, rows: np.ndarray):
        self._source, self._rows = source, np.asarray(rows)
        self.categories = source.categories
        self.objects = np.unique(source.objects[self._rows], return_inverse=True)[1]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Example:
        return self._source[int(self._rows[index])]


def hold_out(source: Source, count: int) -> tuple[Subset, Subset]:
    """The source without some objects, and the first view of each of those. `count`
    objects, evenly spaced, or a tenth of all if that is fewer. A source of a single
    object raises InputError."""
    objects, first = np.unique(source.objects, return_index=True)
    count = min(count, max(1, len(objects) // 10))
    if len(objects) < 2:
        raise InputError("data", "only one object", "add more to train on")
    held = np.unique(np.linspace(0, len(objects) - 1, count + 2, dtype=int)[1:-1])
    train = np.flatnonzero(~np.isin(source.objects, held))
    return Subset(source, train), Subset(source, first[held])
