"""What is held out of a training."""

import numpy as np
import pytest

from prism_jax.data.holdout import hold_out
from prism_jax.data.source import Example, Source
from prism_jax.io.errors import InputError


class Views:
    """Items that know their place: `views` in a row show the same object."""

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


@pytest.mark.parametrize(
    ("objects", "views", "count", "held"),
    [(100, 3, 5, 5), (40, 2, 200, 4), (2, 1, 1, 1)],
)
def test_objects_are_held_out_with_all_their_views(objects, views, count, held):
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
        assert np.array_equal(part.objects, np.unique(numbers, return_inverse=True)[1])
    spread = np.diff([-1, *map(int, out), objects])
    assert spread.min() > 0.5 * objects / (held + 1)


def test_of_a_single_object_nothing_can_be_held_out():
    with pytest.raises(InputError, match="only one object"):
        hold_out(Views(1, 8), 1)
