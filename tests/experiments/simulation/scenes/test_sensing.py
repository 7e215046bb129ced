"""What is measured of a scene, and how it is labelled."""

import numpy as np
import pytest
import trimesh

from experiments.simulation.raycast import Scene
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.scenes.sensing import (
    measured,
    random_camera,
    random_lidar,
)
from prism_jax.preprocessing.segmentation.scene import LEFT_OVER, SUPPORT


def world():
    """A cube of 30 cm on a floor, and the label of each of their faces."""
    cube = trimesh.creation.box((0.3, 0.3, 0.3))
    cube.apply_translation((1.0, 2.0, 0.15))
    floor = trimesh.creation.box((6.0, 6.0, 0.1))
    floor.apply_translation((1.0, 2.0, -0.05))
    return cube, Scene(together([cube, floor])), np.repeat([0, SUPPORT], 12)


@pytest.mark.parametrize("make", [random_camera, random_lidar])
@pytest.mark.parametrize("seed", range(1))
def test_points_are_labelled_by_what_they_are_on(make, seed):
    cube, scene, owners = world()
    rng = np.random.default_rng(seed)
    sensor = make(Scene(cube), False, 0.0, rng)
    points, labels = measured(scene, owners, sensor, rng)
    assert {*np.unique(labels)} <= {0, SUPPORT, LEFT_OVER}
    noise = 6 * max(deviation for _, deviation in sensor.config.noise)
    on_floor = np.abs(points[:, 2]) < noise
    offset = np.abs(points - (1.0, 2.0, 0.15)).max(axis=1) - 0.15
    on_cube = np.abs(offset) < noise
    assert (labels == 0).sum() > 20 and (labels == SUPPORT).sum() > 200
    assert on_cube[labels == 0].mean() > 0.98
    assert on_floor[labels == SUPPORT].mean() > 0.98


def test_points_that_fly_beside_an_edge_are_of_nothing():
    cube, scene, owners = world()
    rng = np.random.default_rng(1)
    sensor = random_camera(Scene(cube), False, 0.0, rng)
    points, labels = measured(scene, owners, sensor, rng)
    strays = points[labels == LEFT_OVER]
    off_cube = np.abs(strays - (1.0, 2.0, 0.15)).max(axis=1) - 0.15
    assert len(strays) > 20
    assert ((np.abs(off_cube) > 0.005) & (np.abs(strays[:, 2]) > 0.005)).mean() > 0.9
