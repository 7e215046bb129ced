"""What is held out of a training."""

import numpy as np
import pytest

from prism_jax.data.holdout import Subset, hold_out
from prism_jax.data.source import Example, Source
from prism_jax.io.errors import InputError


class Views:
    """Items that know their place; of one object stand `views` in a row."""

    categories = ("thing",)

    def __init__(self, objects, views):
        self.objects, self.views = np.repeat(np.arange(objects), views), views

    def __len__(self):
        return len(self.objects)

    def __getitem__(self, index):
        item, view = divmod(range(len(self))[index], self.views)
        return Example(None, None, None, "thing", f"{item}/{view}")


def names(source):
    return [source[index].name for index in range(len(source))]


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize(
    ("objects", "count", "held"), [(100, 5, 5), (100, 200, 10), (2, 9, 1), (7, 1, 1)]
)
def test_an_object_is_on_one_side_alone(objects, views, count, held):
    """All its views are gone from the training, the first one validates."""
    source = Views(objects, views)
    train, validation = hold_out(source, count)
    out = [name.split("/")[0] for name in names(validation)]
    assert len(set(out)) == len(out) == held
    assert names(validation) == [f"{number}/0" for number in out]
    kept = [name for name in names(source) if name.split("/")[0] not in out]
    assert names(train) == kept
    assert len(kept) == (objects - held) * views
    for part in (train, validation):
        assert isinstance(part, Source)
        numbers = [int(name.split("/")[0]) for name in names(part)]
        assert np.array_equal(np.diff(part.objects) > 0, np.diff(numbers) > 0)
        assert part.objects[0] == 0 and part.objects.max() + 1 == len(set(numbers))


def test_they_are_spread_over_the_set_and_always_the_same():
    _, validation = hold_out(Views(1000, 2), 9)
    numbers = [int(name.split("/")[0]) for name in names(validation)]
    assert np.diff(numbers).min() >= 99
    assert names(hold_out(Views(1000, 2), 9)[1]) == names(validation)


def test_of_a_single_object_nothing_can_be_held_out():
    with pytest.raises(InputError, match="only one object"):
        hold_out(Views(1, 8), 1)


def test_a_subset_has_the_items_of_its_rows():
    subset = Subset(Views(5, 1), np.array([4, 0, 2]))
    assert names(subset) == ["4/0", "0/0", "2/0"]
    assert isinstance(subset, Source)
    with pytest.raises(IndexError):
        subset[3]
