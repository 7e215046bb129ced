"""Types and ranges of settings."""

import dataclasses
import math
from typing import Annotated, Literal

import pytest

from prism_jax.models.ranges import Checked


@dataclasses.dataclass(frozen=True)
class Sizes(Checked):
    count: Annotated[int, 1, 9] = 3
    rate: Annotated[float, 0, 1] = 0.5
    pair: Annotated[tuple[int, int], 1, 9] = (1, 2)
    levels: Annotated[tuple[tuple[int, ...], ...], 1, 9] = ((1, 2), (1,))
    switch: bool = True
    words: tuple[Literal["near", "far"], ...] = ("far",)
    some: Annotated[int | None, 1, 9] = None


@dataclasses.dataclass(frozen=True)
class Holder(Checked):
    sizes: Sizes = Sizes()


def test_in_range():
    Sizes(count=1, rate=0.0, switch=False, words=("near", "far"), some=9)
    sizes = Sizes(count=9, rate=1, pair=(9, 9), levels=((9,) * 8,) * 8)
    Holder(sizes)
    with pytest.raises(ValueError, match=r"Holder\.sizes must be a Sizes"):
        Holder({"count": 4})  # pyright: ignore


@pytest.mark.parametrize(
    ("name", "values", "wanted"),
    [
        ("count", (0, 10, 10**400, 3.0, "3", None, True), "an integer from 1 to 9"),
        ("rate", (-0.1, 1.1, math.nan, math.inf, "1", None), "a number from 0 to 1"),
        ("pair", ([1, 2], 1, None, "12"), "a tuple"),
        ("pair", ((), (1,), (1, 2, 3)), "a tuple of 2"),
        ("pair", ((1, 10), (1, 2.0), (1, {})), "an integer from 1 to 9"),
        ("levels", ((), ((),), ((1,),) * 9, ((1,) * 9,)), "a tuple of 1 to 8"),
        ("levels", (((1,), (0,)), ((1, math.nan),)), "an integer from 1 to 9"),
        ("switch", (1, 0, "yes", None), "a bool"),
        ("words", (("far", "away"), ("away",), (None,)), "one of near, far"),
        ("some", (0, 10, 1.5, "1", True), "an integer from 1 to 9"),
    ],
)
def test_out_of_range(name, values, wanted):
    for value in values:
        with pytest.raises(ValueError, match=rf"Sizes\.{name} must be {wanted}, not "):
            Sizes(**{name: value})
