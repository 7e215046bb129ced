"""Scenes: what is measured of them, on disk, as things one by one, and whole."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from experiments.simulation.raycast import Scene
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.scenes.build import MIN_RETURNS, ScenesConfig, build_scenes
from experiments.simulation.scenes.sensing import measured, random_camera, random_lidar
from prism_jax.data.datasets import open_dataset
from prism_jax.data.scenes import Scenes
from prism_jax.data.source import Source
from prism_jax.geometry.visibility import BACKGROUND, NEARER, SURFACE, UNKNOWN
from prism_jax.preprocessing.segmentation.scene import LEFT_OVER, SUPPORT
from prism_jax.preprocessing.visibility_map import in_free_space
from tests.experiments.simulation.objects.conftest import catalogue_dir, write_catalogue

__all__ = ["catalogue_dir", "write_catalogue"]

CONFIG = ScenesConfig("validation", num_scenes=2, shard_scenes=1)


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Scenes:
    """Two validation scenes in shards of their own."""
    folder = tmp_path_factory.mktemp("scenes")
    build_scenes(CONFIG, folder, 0, progress=False)
    found = open_dataset("scenes", "validation", folder)
    assert isinstance(found, Scenes) and isinstance(found, Source)
    return found


def test_items_are_the_things_each_measured_and_on_its_own_surface(source):
    """And nothing that was measured lies where a thing's map says that it is free."""
    states, index = set(), 0
    for number in range(source.num_scenes):
        scene = source.scene(number)
        counts = np.bincount(scene.labels[scene.labels >= 0])
        assert 2 <= len(counts) == len(scene.complete) <= 8
        assert counts.min() >= MIN_RETURNS
        assert {*np.unique(scene.labels)} >= {SUPPORT, LEFT_OVER, 0}
        assert scene.complete[..., 2].min() > -1e-3
        for thing, complete in enumerate(scene.complete):
            points = scene.points[scene.labels == thing]
            apart, _ = KDTree(complete).query(points)
            assert np.median(apart) < 0.02 * np.ptp(complete, axis=0).max() + 0.02
            example = source[index]
            assert source.objects[index] == number
            assert example.name == f"{number:06d}/{thing}"
            assert example.category == scene.categories[thing]
            assert example.ordered and example.any_heading
            np.testing.assert_array_equal(example.complete, complete)
            np.testing.assert_allclose(example.eye, scene.eye, rtol=1e-6)
            assert KDTree(points).query(example.partial)[0].max() < 1e-3
            known = example.visibility
            np.testing.assert_allclose(known.camera.position, scene.eye, atol=1e-5)
            assert not in_free_space(scene.points.astype(float), known, 1e-3).any()
            states |= set(known.state.ravel())
            index += 1
    assert states == {UNKNOWN, SURFACE, NEARER, BACKGROUND} and index == len(source)


@pytest.mark.parametrize("make", [random_camera, random_lidar])
def test_points_are_labelled_by_what_they_are_on(make):
    """A cube of 30 cm on a floor; what flies beside an edge is of neither."""
    cube = trimesh.creation.box((0.3, 0.3, 0.3)).apply_translation((1.0, 2.0, 0.15))
    floor = trimesh.creation.box((6.0, 6.0, 0.1)).apply_translation((1.0, 2.0, -0.05))
    scene, owners = Scene(together([cube, floor])), np.repeat([0, SUPPORT], 12)
    rng = np.random.default_rng(1)
    sensor = make(Scene(cube), False, 0.0, rng)
    points, labels = measured(scene, owners, sensor, rng)
    off_floor = np.abs(points[:, 2])
    off_cube = np.abs(np.abs(points - (1.0, 2.0, 0.15)).max(axis=1) - 0.15)
    noise = 6 * max(deviation for _, deviation in sensor.config.noise)
    on_cube, on_floor, stray = (labels == n for n in (0, SUPPORT, LEFT_OVER))
    assert np.all(on_cube | on_floor | stray)
    assert on_cube.sum() > 20 and on_floor.sum() > 200
    assert np.mean(off_cube[on_cube] < noise) > 0.98
    assert np.mean(off_floor[on_floor] < noise) > 0.98
    if make is random_camera:
        assert stray.sum() > 20
        flies = (off_cube > 0.005) & (off_floor > 0.005)
        assert np.mean(flies[stray]) > 0.9
