"""Depth camera and lidar against plain NumPy and their data sheets."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy import stats

from experiments.simulation.raycast import Scene
from experiments.simulation.sensors import (
    L515Config,
    OusterConfig,
    l515_depth,
    ouster_scan,
)
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.framing import camera_axes
from tests.experiments.simulation.test_raycast import moeller_trumbore

ALONG_X = camera_axes(np.array([1.0, 0.0, 0.0]))
ORIGIN = np.zeros(3)


def wall(distance: float, size: float = 400.0, tilt_degrees: float = 0.0) -> Scene:
    """A square wall across +x, turned about z by the tilt."""
    turn = np.radians(tilt_degrees)
    across, up = np.array([-np.sin(turn), np.cos(turn), 0]), np.array([0, 0, 1.0])
    corners = [
        [distance, 0, 0] + size / 2 * (i * across + j * up)
        for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    return Scene(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))


def small_camera(pixels: int = 60, fov_degrees: float = 20.0) -> Camera:
    """A camera at the origin that looks along +x."""
    focal = pixels / 2 / np.tan(np.radians(fov_degrees / 2))
    middle = (pixels - 1) / 2
    intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    return Camera(ALONG_X, ORIGIN, intrinsics, pixels, pixels)


@pytest.fixture(scope="module")
def cluttered() -> Scene:
    """A few solids at some metres around the origin."""
    parts = [
        trimesh.creation.icosphere(1, radius=0.4).apply_translation((2.0, 0.2, 0.1)),
        trimesh.creation.box((0.3, 1.0, 0.5)).apply_translation((3.0, -0.6, 0.0)),
        trimesh.creation.box((0.2, 4.0, 3.0)).apply_translation((5.0, 0.0, 0.0)),
    ]
    return Scene(trimesh.util.concatenate(parts))


def test_exact_depth_agrees_with_plain_numpy(cluttered):
    camera, config = small_camera(24, 50.0), L515Config().exact()
    counts, faces = l515_depth(cluttered, camera, np.random.default_rng(0), config)
    rows, columns = np.indices((24, 24))
    pixels = np.stack([columns, rows, np.ones((24, 24))], axis=-1).reshape(-1, 3)
    rays = np.linalg.solve(camera.intrinsics, pixels.T).T
    distance, expected_faces = moeller_trumbore(
        cluttered.triangles, np.zeros((576, 3)), rays @ camera.rotation
    )
    depth = distance / np.linalg.norm(rays, axis=1)
    np.testing.assert_array_equal(faces.ravel(), expected_faces)
    hit = expected_faces >= 0
    assert 200 < hit.sum() < 576
    np.testing.assert_array_equal(counts.ravel() > 0, hit)
    error = np.abs(counts.ravel()[hit] * 0.00025 - depth[hit])
    assert error.max() <= 0.000125 + 2e-6  # half a count, and Embree's float32


def test_exact_scan_agrees_with_plain_numpy(cluttered):
    config = OusterConfig(beams=16, columns=60).exact()
    turn = trimesh.transformations.rotation_matrix(0.3, (1, 2, 3))[:3, :3]
    position = np.array([0.3, -0.1, 0.2])
    rng = np.random.default_rng(0)
    returns = ouster_scan(cluttered, position, rng, config, turn)
    elevation = np.radians(np.linspace(22.5, -22.5, 16))
    beams = [
        turn @ [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]
        for e in elevation
        for a in np.arange(60) * 2 * np.pi / 60
    ]
    distance, faces = moeller_trumbore(
        cluttered.triangles, np.tile(position, (960, 1)), np.array(beams)
    )
    hit = faces >= 0
    assert 50 < hit.sum() < 960
    np.testing.assert_array_equal(returns.faces, faces[hit])
    assert np.abs(returns.ranges - distance[hit]).max() <= 0.0005 + 2e-6
    expected = position + np.array(beams)[hit] * returns.ranges[:, None]
    np.testing.assert_allclose(returns.points, expected, atol=1e-12)


@pytest.mark.parametrize("distance", [1.0, 5.0])
def test_l515_noise_is_that_of_the_data_sheet(distance):
    """2.5 mm at 1 m, 15.5 mm at 9 m, in a straight line between; Gaussian."""
    claimed = 0.0025 + (distance - 1) / 8 * 0.013
    noisy = dataclasses.replace(L515Config().exact(), noise=L515Config().noise)
    camera = small_camera(60, 0.5)
    counts, _ = l515_depth(wall(distance), camera, np.random.default_rng(2), noisy)
    error = counts.ravel() * 0.00025 - distance
    assert error.std() == pytest.approx(claimed, rel=0.05)
    assert stats.kstest(error / claimed, "norm").pvalue > 1e-3


@pytest.mark.parametrize(
    ("tilt", "kept"), [(0, 0.8), (20, 0.8 * 0.75 * 0.8), (60, 0.8 * 0.5 * 0.4)]
)
def test_losses_grow_with_the_angle_and_are_independent(tilt, kept):
    """Everywhere, at grazing angles and on glossy faces; without gloss, two of them."""
    config = dataclasses.replace(
        L515Config().exact(),
        dropout=0.2,
        grazing_degrees=(0.0, 40.0),
        grazing_dropout=0.5,
        gloss_degrees=(10.0, 40.0),
        gloss_dropout=0.6,
    )
    camera, scene = small_camera(100, 0.01), wall(2.0, tilt_degrees=tilt)
    mirrored = {0: 1.0, 20: 0.8, 60: 0.4}[tilt]
    for glossy, expected in ((True, kept), (False, kept / mirrored)):
        rng, flags = np.random.default_rng(4), np.full(2, glossy)
        counts, faces = l515_depth(scene, camera, rng, config, flags)
        np.testing.assert_array_equal(faces == -1, counts == 0)
        assert np.mean(counts > 0) == pytest.approx(expected, abs=0.02)
