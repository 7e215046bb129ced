"""Sums of small decision trees, fitted elsewhere and read by NumPy alone."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, jaxtyped

MAX_TREES = 1000  # every row has a number for each


@dataclasses.dataclass(frozen=True)
class Trees:
    """A number from numbers: what each of several decision trees adds to a base.

    Each tree is complete: node n splits into 2 n + 1, where the number that it looks at
    is at most its threshold, and 2 n + 2. What is made of such a sum adds its fields.
    """

    WHAT: ClassVar[str] = "a sum of trees"
    """What errors call it."""

    NAMES: ClassVar[tuple[str, ...]] = ()
    """Of the numbers that nodes look at, in their order."""

    base: float  # what the trees' sum is added to
    looks_at: Float[np.ndarray, "T N"]  # which number each node of each tree looks at
    thresholds: Float[np.ndarray, "T N"]  # of that number
    leaves: Float[np.ndarray, "T N+1"]  # what each leaf adds
    # The least and the largest sum that was met where they were fitted.
    bounds: Float[np.ndarray, "2"]

    def sums(self, rows: Float[np.ndarray, "*R E"]) -> Float[np.ndarray, "*R"]:
        """Of each row of numbers, which may lie beyond what was met. A row's sum is the
        same to the last bit whatever the others are."""
        (trees, nodes), columns = self.looks_at.shape, self.looks_at.astype(int)
        tree, node = np.arange(trees), np.zeros((*rows.shape[:-1], trees), int)
        for _ in range((nodes + 1).bit_length() - 1):
            seen = np.take_along_axis(rows, columns[tree, node], axis=-1)
            node = 2 * node + 1 + (seen > self.thresholds[tree, node])
        return np.asarray(self.base + self.leaves[tree, node - nodes].sum(axis=-1))

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Any:
        """From what `to_dict` gave; anything else raises ValueError."""
        kinds: Any = {field.name: field.type for field in dataclasses.fields(cls)}
        if not isinstance(fields, Mapping) or set(fields) != set(kinds):
            raise ValueError(f"{cls.WHAT} needs exactly {', '.join(kinds)}")
        try:
            arrays = {name: np.asarray(fields[name], np.float64) for name in kinds}
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{cls.WHAT} must hold numbers: {error}") from None
        with jaxtyped("context"):  # in which T and N are the same for all
            for name, array in arrays.items():
                scalar = array.ndim == 0 and kinds[name] is float
                if not (scalar or isinstance(array, kinds[name])):
                    raise ValueError(f"{cls.WHAT}'s {name} has the shape {array.shape}")
                if not np.isfinite(array).all():
                    raise ValueError(f"{cls.WHAT}'s {name} is not finite")
        trees, nodes = arrays["looks_at"].shape
        if trees > MAX_TREES or nodes & (nodes + 1):
            raise ValueError(f"{cls.WHAT} has {trees:,} trees of {nodes:,} nodes")
        if not np.isin(arrays["looks_at"], np.arange(len(cls.NAMES))).all():
            raise ValueError(f"{cls.WHAT}'s looks_at is out of range")
        if not -100 < arrays["bounds"][0] <= arrays["bounds"][1] < 100:  # logarithms
            raise ValueError(f"{cls.WHAT}'s bounds are out of range")
        scalars: Any = {name: float(a) for name, a in arrays.items() if a.ndim == 0}
        return cls(**(arrays | scalars))

    def to_dict(self) -> dict[str, Any]:
        """Lists and numbers, six digits of each."""
        digits = np.vectorize(lambda number: float(f"{number:.6g}"))
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: digits(value).tolist() for name, value in fields.items()}
