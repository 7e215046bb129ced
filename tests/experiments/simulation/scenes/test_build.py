"""Scenes on disk, as things one by one, and whole."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.simulation.scenes.arrangement import pools_of
from experiments.simulation.scenes.build import (
    MIN_RETURNS,
    make_scene,
)
from experiments.simulation.shapes import NOVEL_CATEGORIES
from prism_jax.data.datasets import open_dataset
from prism_jax.data.scenes import Scenes
from prism_jax.data.source import Source
from prism_jax.geometry.visibility import BACKGROUND, NEARER, SURFACE, UNKNOWN
from prism_jax.preprocessing.segmentation.scene import LEFT_OVER, SUPPORT
from prism_jax.preprocessing.visibility_map import in_free_space
from tests.data.conftest import digests
from tests.experiments.simulation.objects.conftest import catalogue_dir, write_catalogue
from tests.experiments.simulation.scenes.conftest import CONFIG

__all__ = ["catalogue_dir", "digests", "write_catalogue"]


@pytest.fixture(scope="module")
def source(scenes_dir) -> Scenes:
    found = open_dataset("scenes", "validation", scenes_dir)
    assert isinstance(found, Scenes) and isinstance(found, Source)
    return found


def test_a_scene_is_read_as_it_was_made(source):
    assert source.num_scenes == 3
    for number in (0, 2):
        made = make_scene(CONFIG, pools_of("validation"), number)
        scene = source.scene(number)
        assert scene.name == f"{number:06d}" and scene.traits == made.traits
        np.testing.assert_array_equal(scene.labels, made.measured.labels)
        step = np.ptp(made.measured.points, axis=0).max() / 2**16
        np.testing.assert_allclose(scene.points, made.measured.points, atol=step)
        np.testing.assert_allclose(scene.complete, made.complete, atol=1e-4)
        np.testing.assert_array_equal(scene.eye, made.sensor.rays.eye)
        np.testing.assert_array_equal(scene.rotation, made.sensor.rotation)
        assert scene.categories == tuple(thing.category for thing in made.things)
    with pytest.raises(IndexError):
        source.scene(3)


def test_every_thing_is_measured_and_on_its_own_surface(source):
    for number in range(source.num_scenes):
        scene = source.scene(number)
        counts = np.bincount(scene.labels[scene.labels >= 0])
        assert 2 <= len(counts) == len(scene.complete) <= 8
        assert counts.min() >= MIN_RETURNS
        assert {*np.unique(scene.labels)} >= {SUPPORT, LEFT_OVER, 0}
        assert scene.complete[..., 2].min() > -1e-3
        for thing, complete in enumerate(scene.complete):
            apart, _ = KDTree(complete).query(scene.points[scene.labels == thing])
            assert np.median(apart) < 0.02 * np.ptp(complete, axis=0).max() + 0.02


def test_what_the_sensor_knows_of_a_thing_is_told_by_the_whole_scene(source):
    """Nothing that was measured lies where it says that there is nothing."""
    states = set()
    for index, number in enumerate(source.objects):
        known = source[index].visibility
        scene = source.scene(int(number))
        np.testing.assert_allclose(known.camera.position, scene.eye, atol=1e-5)
        assert not in_free_space(scene.points.astype(float), known, 1e-3).any()
        states |= set(known.state.ravel())
    assert states == {UNKNOWN, SURFACE, NEARER, BACKGROUND}


def test_items_are_the_things_and_a_scene_counts_as_one_object(source):
    counts = [len(source.scene(number).complete) for number in range(3)]
    assert source.objects.tolist() == np.repeat(range(3), counts).tolist()
    scene = source.scene(1)
    for thing in range(counts[1]):
        example = source[counts[0] + thing]
        assert example.name == f"000001/{thing}"
        assert example.category == scene.categories[thing]
        assert example.ordered and example.any_heading
        np.testing.assert_array_equal(example.complete, scene.complete[thing])
        np.testing.assert_allclose(example.eye, scene.eye, rtol=1e-6)
        measured = KDTree(scene.points[scene.labels == thing])
        assert measured.query(example.partial)[0].max() < 1e-3


def test_in_its_own_axes_the_sensor_is_at_the_origin_and_looks_along_z(source):
    scene = source.scene(0)
    own = scene.in_sensor_axes()
    assert own.points[:, 2].min() > 0
    np.testing.assert_array_equal(own.eye, np.zeros(3))
    back = own.points @ scene.rotation + scene.eye
    np.testing.assert_allclose(back, scene.points, atol=1e-5)
    back = own.complete @ scene.rotation + scene.eye
    np.testing.assert_allclose(back, scene.complete, atol=1e-5)
    np.testing.assert_array_equal(own.labels, scene.labels)


def test_things_are_of_the_sources_own_splits(catalogue_dir):
    assert len(pools_of("train").pools) == 2
    assert len(pools_of("validation").pools) == 2
    assert not {*NOVEL_CATEGORIES} & {*pools_of("test").categories}
    assert "open" in pools_of("train").categories
    assert "open" not in pools_of("test").categories
    models = pools_of("test", ("objects",), catalogue_dir, progress=False)
    assert models.digests and all(name.startswith("Scopia/") for name in models.digests)
    thing = models.draw(np.random.default_rng(0))
    assert thing.two_sided and thing.category in models.categories
