"""Maps: their camera against `Camera.framing`, and which reading a pixel shows."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.simulation.readings import Readings, map_of, map_rays
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.framing import framing_camera
from prism_jax.geometry.visibility import (
    BACKGROUND,
    MAP_MARGIN,
    MAP_SIZE,
    NEARER,
    SURFACE,
    UNKNOWN,
    look_up,
)


def cloud(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (200, 3)) * [1, 0.5, 0.8]


@pytest.mark.parametrize("eye", [(3, 1, 1.0), (0, -9, 0.5), (-2, 2, -0.4), (0, 0, 4.0)])
def test_the_camera_is_that_of_framing(eye):
    found = framing_camera(cloud(), np.array(eye))
    points = jnp.asarray(cloud())
    expected = Camera.framing(points, eye, MAP_MARGIN, MAP_SIZE, MAP_SIZE)
    assert (found.height, found.width) == (expected.height, expected.width)
    pixels = [camera.project(cloud())[0] for camera in (found, expected)]
    if eye[:2] != (0, 0):  # Straight above, the two have another side up.
        np.testing.assert_allclose(*pixels, atol=1e-3)
    offset = np.abs(np.asarray(pixels[0]) - (MAP_SIZE - 1) / 2).max()
    assert offset == pytest.approx(MAP_SIZE / 2 / MAP_MARGIN, rel=1e-3)


def test_rays_pass_through_the_middle_and_the_corners_of_every_pixel():
    eye = np.array([2.0, -3.0, 1.0])
    camera = framing_camera(cloud(), eye)
    rays = map_rays(camera, eye)
    points = eye + 2.5 * rays.directions.reshape(-1, 3)
    uv, depth = camera.project(points)
    np.testing.assert_allclose(depth, 2.5, rtol=1e-5)
    pixel = np.repeat(np.arange(MAP_SIZE**2), 5)
    np.testing.assert_array_equal(camera.pixel_of(points)[0], pixel)
    rows, columns = np.indices((MAP_SIZE, MAP_SIZE)).reshape(2, -1)
    offsets = np.asarray(uv).reshape(-1, 5, 2) - np.stack([columns, rows], -1)[:, None]
    np.testing.assert_allclose(offsets[:, 0], 0, atol=1e-3)
    np.testing.assert_allclose(np.abs(offsets[:, 1:]), 0.5, atol=2e-3)
    np.testing.assert_allclose(offsets[:, 1:].sum(axis=1), 0, atol=5e-3)


def test_surface_comes_first_then_doubt_then_what_is_nearest():
    """Readings of rays through a few pixels, whichever comes first."""
    eye = np.array([2.0, -3.0, 1.0])
    camera = framing_camera(cloud(), eye)
    rays = map_rays(camera, eye).directions.reshape(-1, 5, 3)[:, 0]
    samples = [
        (0, NEARER, 1.0),
        (0, SURFACE, 3.0),
        (0, SURFACE, 2.0),
        (0, BACKGROUND, 5.0),
        (0, UNKNOWN, 1.0),
        (70, BACKGROUND, 5.0),
        (70, NEARER, 1.5),
        (70, NEARER, 2.5),
        (500, BACKGROUND, 5.0),
        (500, BACKGROUND, 4.0),
        (501, UNKNOWN, 1.0),
        (501, BACKGROUND, 4.0),
        (502, SURFACE, -1.0),
    ]
    expected = {0: (SURFACE, 2.0), 70: (NEARER, 1.5), 500: (BACKGROUND, 4.0)}
    rng = np.random.default_rng(0)
    for _ in range(5):
        order = rng.permutation(len(samples))
        pixels, states, depths = zip(*(samples[i] for i in order), strict=True)
        points = eye + np.array(depths)[:, None] * rays[list(pixels)]
        state = np.array(states, np.uint8)
        parts = [
            Readings(state[part], points[part], 0.0)
            for part in (slice(4), slice(4, None))
        ]
        found = map_of(camera, parts)
        assert found.state.dtype == np.uint8 and found.depth.dtype == np.float32
        known = np.flatnonzero(found.state)
        assert set(known) == set(expected)
        for pixel, (wanted, depth) in expected.items():
            assert found.state.flat[pixel] == wanted
            assert found.depth.flat[pixel] == pytest.approx(depth, rel=1e-6)
        assert np.all(found.depth[found.state == UNKNOWN] == 0)


def test_surface_that_was_measured_is_found_at_its_pixel():
    points, eye = cloud(3), np.array([0.5, -4.0, 1.0])
    camera = framing_camera(points, eye)
    readings = Readings(np.full(len(points), SURFACE, np.uint8), points, 0.0)
    state, behind = look_up(map_of(camera, [readings]), points)
    assert np.all(state == SURFACE)
    assert behind.min() >= -1e-6
