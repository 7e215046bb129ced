"""Data sets by name, and what is held out of a training."""

import pytest

from experiments.simulation.build_dataset import build_dataset, build_if_missing
from experiments.simulation.shapes import build as shapes_build
from prism_jax.data import datasets
from prism_jax.data.datasets import digest_of, open_dataset, open_training
from prism_jax.io.errors import InputError
from tests.data.test_holdout import Views, names


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
    ("name", "splits", "sizes"),
    [("shapenet55", ["train"], (72, 4)), ("recordings", ["all"], (72, 4))],
)
def test_of_a_set_without_a_validation_split_some_objects_are_held_out(
    monkeypatch, name, splits, sizes
):
    opened = []

    def open_any(*arguments):
        opened.append(arguments)
        return Views(40, 2)

    monkeypatch.setattr(datasets, "open_dataset", open_any)
    assert tuple(map(len, open_training(name, "folder", 7))) == sizes
    assert opened == [(name, split, "folder") for split in splits]


def test_a_set_without_a_training_split_is_refused(tmp_path):
    with pytest.raises(InputError, match="no training split"):
        open_training("shapenet_unseen21", tmp_path)


def test_unknown_names_and_options_are_refused(tmp_path):
    with pytest.raises(InputError, match="unknown value 'shapez'; use one of shapes"):
        open_dataset("shapez", "train")
    with pytest.raises(InputError, match="unknown value 'packed'; use one of shapes"):
        build_dataset("packed", "train", tmp_path)
    with pytest.raises(
        InputError, match=r"^num_points: not an option of shapenet55; .*difficulty"
    ):
        open_dataset("shapenet55", "test", tmp_path, num_points=2048)
