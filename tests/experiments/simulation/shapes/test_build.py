"""The procedural shapes on disk, and as a source."""

import dataclasses
import pickle

import numpy as np
import pytest

from experiments.simulation.shapes import TRAIN_CATEGORIES
from experiments.simulation.shapes.build import ShapesConfig, build_shapes, shape_seed
from experiments.simulation.views import make_views
from prism_jax.data.datasets import folder_of, open_dataset
from prism_jax.data.shards import Shards
from prism_jax.data.source import Source
from prism_jax.io.errors import InputError


@pytest.fixture(scope="module")
def train(shapes_dir):
    return open_dataset("shapes", "train", shapes_dir)


def equal(a, b):
    return all(map(np.array_equal, a, b))


def test_items_are_the_views_of_shape_after_shape(train, train_config):
    assert isinstance(train, Source) and isinstance(train, Shards)
    assert train.objects.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert train.categories == TRAIN_CATEGORIES
    for shape in (0, 3):
        category = TRAIN_CATEGORIES[shape]
        made = make_views(category, shape_seed(train_config, shape), 2)
        for view in range(2):
            example = train[2 * shape + view]
            assert np.array_equal(example.partial, made[0][view])
            assert np.array_equal(example.complete, made[1])
            assert np.array_equal(example.eye, made[2][view])
            assert example.name == f"{shape:06d}/{view:02d}"
            assert example.category == category
            assert example.ordered


def test_a_mixture_keeps_what_the_sensors_knew_and_says_the_kinds(tmp_path, digests):
    """In files of their own; whatever the number of workers, in the same bytes."""
    config = ShapesConfig(
        "test", num_shapes=2, num_views=3, partial="mixed", shard_shapes=1
    )
    folders = [
        build_shapes(config, tmp_path / f"{workers}", workers, progress=False)
        for workers in (0, 2)
    ]
    assert digests(folders[0]) == digests(folders[1])
    source = open_dataset("shapes", "test", tmp_path / "0")
    map_size = np.load(folders[0] / "shard-00000.map.npy", mmap_mode="r")
    assert (map_size.shape, map_size.dtype) == ((3, 64, 64), np.uint16)
    for shape in range(2):
        made = make_views(
            TRAIN_CATEGORIES[shape], shape_seed(config, shape), 3, "mixed"
        )
        for view in range(3):
            example, given = source[3 * shape + view], made.visibilities[view]
            assert example.name == f"{shape:06d}/{view:02d}/{made.kinds[view]}"
            np.testing.assert_array_equal(example.partial, made.partials[view])
            assert example.visibility is not None and given is not None
            found = example.visibility
            np.testing.assert_array_equal(found.state, given.state)
            np.testing.assert_allclose(found.depth, given.depth, rtol=3e-4)
            for name in ("rotation", "translation", "intrinsics"):
                expected = getattr(given.camera, name)
                np.testing.assert_array_equal(getattr(found.camera, name), expected)


def test_indices_count_as_those_of_a_list(train):
    assert equal(train[-1], train[7])
    for index in (8, -9):
        with pytest.raises(IndexError):
            train[index]


def test_it_goes_to_another_process_without_its_arrays(train):
    train[0]
    data = pickle.dumps(train)
    assert len(data) < 2000
    assert equal(pickle.loads(data)[5], train[5])


def test_examples_are_the_callers_own(train):
    before = train[2]
    for array in train[2][:3]:
        array += 1
    assert equal(train[2], before)


def test_shape_seeds_of_splits_and_corpora_are_disjoint():
    configs = [
        ShapesConfig(split, seed=seed)
        for split in ShapesConfig.SIZES
        for seed in range(3)
    ]
    indices = (*range(500), 23999, 2**32 - 1)
    seeds = [shape_seed(config, index) for config in configs for index in indices]
    assert len(set(seeds)) == len(seeds)


def test_seeds_are_those_that_results_were_recorded_with():
    """Splits added later change none of them."""
    recorded = {
        ("train", 0): 7,
        ("validation", 0): 2**32 + 7,
        ("test", 0): 2 * 2**32 + 7,
        ("unseen", 0): 3 * 2**32 + 7,
        ("train", 1): 4 * 2**32 + 7,
        ("unseen", 5): 23 * 2**32 + 7,
        ("novel", 0): 4 * 2**96 + 7,
        ("novel", 5): 4 * 2**96 + 5 * 2**32 + 7,
    }
    for (split, seed), own in recorded.items():
        assert shape_seed(ShapesConfig(split, seed=seed), 7) == own


def test_sizes_are_the_splits_own_unless_given():
    for split, sizes in ShapesConfig.SIZES.items():
        config = ShapesConfig(split)
        assert sizes.items() <= dataclasses.asdict(config).items()
        # Every category as often as every other, but for one.
        counts = np.bincount(np.arange(config.num_shapes) % len(config.categories))
        assert np.ptp(counts) <= 1
    assert ShapesConfig("train", num_views=1).num_views == 1


@pytest.mark.parametrize(
    ("setting", "fault"),
    [
        ({"num_shapes": -1}, "-1 is not within 1"),
        ({"num_views": -1}, "-1 is not within 1"),
        ({"shard_shapes": 0}, "0 is not within 1"),
        ({"seed": -1}, "-1 is not within 0"),
        ({"split": "dev"}, "unknown value 'dev'; use one of train, "),
        ({"partial": "lidar"}, "unknown value 'lidar'; use one of self_"),
    ],
)
def test_settings_without_sense_are_named(setting, fault):
    with pytest.raises(InputError, match=f"{next(iter(setting))}: {fault}"):
        ShapesConfig(**{"split": "train", **setting})


def test_what_is_not_built_says_how(tmp_path):
    with pytest.raises(InputError, match=r"--split=unseen --output_dir="):
        open_dataset("shapes", "unseen", tmp_path)


def test_the_cache_folder_is_where_it_is_built_by_default(tmp_path, monkeypatch):
    monkeypatch.setenv("PRISM_JAX_CACHE", str(tmp_path))
    assert folder_of("shapes", "train") == tmp_path / "shapes-train"
