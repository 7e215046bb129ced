"""What is held out of a training."""

import numpy as np
import pytest

from experiments import splits
from experiments.splits import held_out, validation_rows
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
    ("name", "split", "objects", "views", "count", "held"),
    [
        ("shapenet55", "train", 100, 3, 5, 5),
        ("recordings", "all", 40, 2, 200, 4),
        ("recordings", "all", 2, 1, 1, 1),
    ],
)
def test_without_a_validation_split_objects_are_held_out_with_all_their_views(
    monkeypatch, name, split, objects, views, count, held
):
    opened, source = [], Views(objects, views)

    def open_any(*arguments):
        opened.append(arguments)
        return source

    monkeypatch.setattr(splits, "open_dataset", open_any)
    train, validation = held_out(name, "folder", count)
    assert opened == [(name, split, "folder")]
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
    source = Views(1, 8)
    with pytest.raises(InputError, match="only one object"):
        held_out(name, "folder")
    with pytest.raises(InputError, match="no training split"):
        held_out("shapenet_unseen21", "folder")


def test_what_validates_is_never_for_tests(monkeypatch):
    opened = []

    def open_any(*arguments):
        opened.append(arguments)
        return Views(9, 1)

    monkeypatch.setattr(splits, "open_dataset", open_any)
    rows = [names(validation_rows(text, "f", 3)) for text in ("shapes", "shapes/novel")]
    assert opened == [("shapes", "validation", "f"), ("shapes", "novel", "f")]
    assert rows == 2 * [["0/0", "4/0", "8/0"]]
    for text in ("shapes/test", "shapes/unseen", "shapenet55", "none"):
        with pytest.raises(InputError):
            validation_rows(text)
