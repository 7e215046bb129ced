"""The procedural shapes on disk, and as a source."""

import numpy as np
import pytest

from experiments.simulation import building
from experiments.simulation.shapes import TRAIN_CATEGORIES
from experiments.simulation.shapes.build import ShapesConfig, build_shapes, shape_seed
from experiments.simulation.views import make_views
from prism_jax.data.datasets import open_dataset


def test_a_mixture_keeps_what_the_sensors_knew_and_says_the_kinds(tmp_path):
    config = ShapesConfig("test", num_shapes=1, num_views=3, partial="mixed")
    build_shapes(config, tmp_path, 0, progress=False)
    source = open_dataset("shapes", "test", tmp_path)
    made = make_views(TRAIN_CATEGORIES[0], shape_seed(config, 0), 3, "mixed")
    for view in range(3):
        example, given = source[view], made.visibilities[view]
        np.testing.assert_array_equal(example.partial, made.partials[view])
        np.testing.assert_array_equal(example.complete, made.complete)
        np.testing.assert_array_equal(example.eye, made.eyes[view])
        assert example.name == f"000000/{view:02d}/{made.kinds[view]}"
        found = example.visibility
        np.testing.assert_array_equal(found.state, given.state)
        np.testing.assert_allclose(found.depth, given.depth, rtol=3e-4)
        for name in ("rotation", "translation", "intrinsics"):
            expected = getattr(given.camera, name)
            np.testing.assert_array_equal(getattr(found.camera, name), expected)


@pytest.mark.slow
def test_bytes_depend_neither_on_workers_nor_on_runs(tmp_path, digests, monkeypatch):
    """Two shapes in shards of their own."""
    config = ShapesConfig(
        "test", num_shapes=2, num_views=2, partial="mixed", shard_shapes=1
    )

    def run(name, num_workers):
        return digests(build_shapes(config, tmp_path / name, num_workers, False))

    def first_only(build_item, items, num_workers):
        build_item(items[0])
        yield items[0]
        raise KeyboardInterrupt

    expected = run("here", 0)
    assert run("two", 2) == expected
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(building, "_run", first_only)
        run("broken", 0)
    found = digests(tmp_path / "broken" / "shapes-test")
    assert found.pop("manifest.json") != expected["manifest.json"]
    assert found.items() < expected.items()
    assert run("broken", 0) == expected


def test_seeds_are_disjoint_and_those_that_results_were_recorded_with():
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
    seeds = [
        shape_seed(ShapesConfig(split, seed=seed), index)
        for split in ShapesConfig.SIZES
        for seed in range(3)
        for index in (*range(10), 23999, 2**32 - 1)
    ]
    assert len(set(seeds)) == len(seeds)
