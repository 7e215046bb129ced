"""Data sets by name."""

import pytest

from experiments.simulation.build_dataset import build_dataset, build_if_missing
from experiments.simulation.shapes import build as shapes_build
from experiments.splits import digest_of
from prism_jax.data.datasets import open_dataset
from prism_jax.io.errors import InputError


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
    assert [example.name for example in source] == ["000000/00", "000001/00"]
    # The same files as of an unbroken build, and others than of another seed.
    assert digest == build("b") and len(digest) == 12
    assert build("c", seed=1) not in (None, digest)
    assert digest_of("shapes", "test", tmp_path) is None


def test_unknown_names_and_options_are_refused(tmp_path):
    with pytest.raises(InputError, match="unknown value 'shapez'; use one of shapes"):
        open_dataset("shapez", "train")
    with pytest.raises(InputError, match="unknown value 'packed'; use one of shapes"):
        build_dataset("packed", "train", tmp_path)
    with pytest.raises(
        InputError, match=r"^num_points: not an option of shapenet55; .*difficulty"
    ):
        open_dataset("shapenet55", "test", tmp_path, num_points=2048)
