"""Data sets by name, and what is held out of a training."""

import numpy as np
import pytest

from experiments.simulation.build_dataset import build_dataset, build_if_missing
from experiments.simulation.shapes import build as shapes_build
from prism_jax.data import datasets
from prism_jax.data.datasets import digest_of, open_dataset, open_training
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


def test_what_was_broken_off_goes_on(tmp_path, monkeypatch):
    def build(folder, **settings):
        settings |= {"num_workers": 0, "num_shapes": 2}
        build_if_missing("shapes", "validation", tmp_path / folder, **settings)
        return digest_of("shapes", "validation", tmp_path / folder)

    def broken(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shapes_build, "make_views", broken)
        build("a")
    digest = build("a")
    source = open_dataset("shapes", "validation", tmp_path / "a")
    assert names(source) == ["000000/00", "000001/00"]
    # The same files as of an unbroken build, and others than of another seed.
    assert digest == build("b") and len(digest) == 12
    assert build("c", seed=1) not in (None, digest)
    assert digest_of("shapes", "test", tmp_path) is None


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

    monkeypatch.setattr(datasets, "open_dataset", open_any)
    train, validation = open_training(name, "folder", count)
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
        open_training(name, "folder")


def test_unknown_names_and_options_are_refused(tmp_path):
    with pytest.raises(InputError, match="unknown value 'shapez'; use one of shapes"):
        open_dataset("shapez", "train")
    with pytest.raises(InputError, match="no training split"):
        open_training("shapenet_unseen21", tmp_path)
    with pytest.raises(InputError, match="unknown value 'packed'; use one of shapes"):
        build_dataset("packed", "train", tmp_path)
    with pytest.raises(
        InputError, match=r"^num_points: not an option of shapenet55; .*difficulty"
    ):
        open_dataset("shapenet55", "test", tmp_path, num_points=2048)
