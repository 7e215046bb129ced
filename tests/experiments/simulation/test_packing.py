"""Packed sources: what comes back, whole shards, and several sources together."""

import pickle

import numpy as np
import pytest

from experiments import mixture
from experiments.assets import CELLS
from experiments.simulation.packing import PackConfig, pack
from prism_jax.data.pipeline import Framing, frame_example
from prism_jax.data.recordings import RecordedCells
from prism_jax.data.shards import Shards
from prism_jax.data.source import Example, Source
from prism_jax.geometry.visibility import SURFACE, nothing_known
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError

CONFIG = PackConfig(num_partial=64, num_complete=128)


class Balls:
    """Ordered clouds of any place and size, some without a known sensor."""

    categories = ("ball", "egg")

    def __init__(self, count=5):
        self.count, self.objects = count, np.arange(count)

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        rng = np.random.default_rng(range(self.count)[index])
        cloud = rng.normal(size=(200, 3)) * 10.0**index + 100 * index
        cloud = cloud.astype(np.float32)
        eye = None if index % 2 else np.float32([index, 2, 3])
        category = self.categories[index % 2]
        return Example(cloud, cloud[:90], eye, category, f"{index}", ordered=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    sources = {"balls": Balls(), "cells": RecordedCells(CELLS)}
    folder = tmp_path_factory.mktemp("packed") / "train"
    return pack(sources, folder, CONFIG, num_workers=0, progress=False)


def test_clouds_come_back_to_half_a_step(folder):
    source = Shards(folder)
    assert isinstance(source, Source)
    for index in range(5):
        given, found = Balls()[index], source[index]
        side = np.ptp(given.complete, axis=0).max()
        for cloud, whole in (
            (found.partial, given.partial[:64]),
            (found.complete, given.complete[:128]),
        ):
            assert cloud.dtype == np.float32
            # Half a step, and the rounding of single precision far from the origin.
            bound = 0.51 * side / 65535 + 2e-7 * np.abs(whole).max()
            assert np.abs(cloud - whole).max() <= bound
        assert (found.category, found.name) == (given.category, f"balls/{index}")
        assert found.ordered
        assert not found.any_heading
        if given.eye is None:
            assert found.eye is None
        else:
            np.testing.assert_array_equal(found.eye, given.eye)


def test_unordered_clouds_are_ordered(folder):
    """Framed for a training they are what they were, to a step."""
    framing = Framing(32, 64, 1.4)
    examples = RecordedCells(CELLS)[3], Shards(folder)[5 + 3]
    given, found = (frame_example(example, framing) for example in examples)
    half, packed = (
        float(Workspace.from_points(e.partial, 1.4).half_extent) for e in examples
    )
    assert packed == pytest.approx(half, rel=0.05)
    partial = found.partial * packed
    center = (given.partial * half)[0] - partial[0]
    np.testing.assert_allclose(partial + center, given.partial * half, atol=1e-3 * half)


def test_sources_stand_one_after_the_other(folder):
    source = Shards(folder)
    assert len(source) == 5 + 12
    arms = RecordedCells(CELLS).categories
    assert set(source.categories) == {"ball", "egg", *arms}
    assert source[5].name == f"cells/{RecordedCells(CELLS)[0].name}"
    assert source[5].any_heading and RecordedCells(CELLS)[0].any_heading
    with pytest.raises(IndexError):
        source[17]
    again = pickle.loads(pickle.dumps(source))
    np.testing.assert_array_equal(again[7].complete, source[7].complete)


class Seen(Balls):
    """Three views of each of two balls, the second of which changes with its views."""

    def __init__(self):
        super().__init__(6)
        self.objects = np.repeat([0, 1], 3)

    def __getitem__(self, index):
        moved = index if index > 2 else 0
        whole = super().__getitem__(moved)
        partial = whole.complete[10 * index :][:70]
        return whole._replace(partial=partial, name=f"{index}")


class Mapped(Balls):
    """Each with a map of one known pixel."""

    def __getitem__(self, index):
        known = nothing_known()
        known.state[index, 3], known.depth[index, 3] = SURFACE, 2.5
        return super().__getitem__(index)._replace(visibility=known)


def test_maps_are_carried_on_and_where_there_are_none_nothing_is_known(tmp_path):
    """Packed with others, and packed again."""
    pack({"balls": Balls(2), "maps": Mapped(3)}, tmp_path / "a", CONFIG, 0, False)
    again = {"again": Shards(tmp_path / "a")}
    pack(again, tmp_path / "b", CONFIG, 0, False)
    for source in (Shards(tmp_path / "a"), Shards(tmp_path / "b")):
        for index in range(5):
            known = source[index].visibility
            assert known is not None
            expected = nothing_known()
            if index >= 2:
                expected = Mapped(3)[index - 2].visibility
            np.testing.assert_array_equal(known.state, expected.state)
            np.testing.assert_array_equal(known.depth, expected.depth)
    pickled = pickle.loads(pickle.dumps(Shards(tmp_path / "b")))
    np.testing.assert_array_equal(pickled[4].visibility.state, known.state)


def test_views_of_an_object_share_its_complete_cloud(tmp_path):
    """As far as it is the same: a robot moves while it is recorded."""
    sources = {"seen": Seen(), "balls": Balls(2)}
    source = Shards(pack(sources, tmp_path, CONFIG, 0, False))
    assert source.objects.tolist() == [0, 0, 0, 1, 1, 1, 2, 3]
    assert len(np.load(tmp_path / "shard-00000.complete.npy")) == 1 + 3 + 2
    assert len(np.load(tmp_path / "shard-00000.partial.npy")) == 8
    for index in range(6):
        given, found = Seen()[index], source[index]
        assert found.name == f"seen/{index}"
        step = 1e-4 * np.ptp(given.complete)
        np.testing.assert_allclose(found.partial, given.partial[:64], atol=step)
        np.testing.assert_allclose(found.complete, given.complete[:128], atol=step)


def test_a_limit_takes_evenly(tmp_path):
    config = PackConfig(8, 8, limit=3)
    pack({"a": Balls(9), "b": Balls(2)}, tmp_path / "x", config, 0, False)
    names = [Shards(tmp_path / "x")[i].name for i in range(5)]
    assert names == ["a/0", "a/4", "a/8", "b/0", "b/1"]


def test_an_example_without_a_partial_is_refused(tmp_path):
    class Whole(Balls):
        def __getitem__(self, index):
            return super().__getitem__(index)._replace(partial=None)

    with pytest.raises(InputError, match="both clouds"):
        pack({"whole": Whole()}, tmp_path / "x", CONFIG, 0, False)


class OfKinds(Balls):
    """Views whose names end in their kinds."""

    kinds = ("clear", "occluded", "noisy+stations", "truncated+noisy", "rail")

    def __getitem__(self, index):
        example = super().__getitem__(index)
        return example._replace(name=f"{index}/00/{self.kinds[index]}")


def test_whole_views_are_told_by_their_names_and_drawn_as_often_as_asked(tmp_path):
    expected = [True, False, True, False, False]
    source = OfKinds()
    pack({"kinds": source}, tmp_path / "packed-train", CONFIG, 0, False)
    shards = Shards(tmp_path / "packed-train")
    assert shards.whole.tolist() == expected
    (whole, often), (others, seldom) = mixture.parts_of(shards, 0.75)
    assert [example.name[-5:] for example in _all(whole)] == ["clear", "tions"]
    assert (len(others), often, seldom) == (3, 0.75, 0.25)
    assert [len(part) for part, _ in mixture.parts_of(shards, 1.0)] == [2]
    assert mixture.parts_of(shards, None) == [(shards, 1.0)]


def _all(source):
    return [source[index] for index in range(len(source))]
