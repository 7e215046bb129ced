"""Readings of a ball before a wall and behind a plate, in closed form."""

import dataclasses

import numpy as np
import pytest
import trimesh

from experiments.simulation.raycast import Scene
from experiments.simulation.readings import (
    Rays,
    World,
    ring_rays,
)
from experiments.simulation.sensors import L515Config, OusterConfig
from experiments.simulation.surroundings import Surroundings
from prism_jax.geometry.visibility import BACKGROUND, NEARER, SURFACE, UNKNOWN

EXACT = L515Config().exact()
EYE = np.array([0.0, -5.0, 0.0])
WALL = np.array([(0.0, -1, 0, -2)])
"""At y = 2, seen from below."""


@pytest.fixture(scope="module")
def ball() -> Scene:
    return Scene(trimesh.creation.icosphere(4))


@pytest.fixture(scope="module")
def plate() -> Scene:
    """At y = -3, hiding what is right of the middle."""
    return Scene(trimesh.creation.box(bounds=[(0, -3.0, -2), (2, -2.9, 2)]))


def grid(half: float = 0.6, count: int = 32) -> Rays:
    """Rays of depth one around +y."""
    ticks = np.linspace(-half, half, count)
    x, z = np.meshgrid(ticks, -ticks)
    return Rays(EYE, np.stack([x, np.ones_like(x), z], axis=-1))


def test_states_and_depths_of_an_exact_camera(ball, plate):
    rays = grid()
    world = World(ball, Surroundings(plate, WALL), 0.5)
    found = world.read(rays, EXACT, np.random.default_rng(0))
    x, _, z = rays.directions.reshape(-1, 3).T
    hidden = (x > 0) & (abs(x) <= 1) & (abs(z) <= 1)
    # A ray meets the unit ball 5 away where its tangent is below 1 / sqrt(24).
    tangent = np.hypot(x, z)
    on_ball = tangent < 0.2
    assert np.all(found.state[hidden] == NEARER)
    assert np.all(found.state[~hidden & on_ball] == SURFACE)
    assert np.all(found.state[~hidden & (tangent > 0.21)] == BACKGROUND)
    depth = found.points[:, 1] - EYE[1]
    step = EXACT.quantum / 0.5
    np.testing.assert_allclose(depth[hidden], 2, atol=step)
    np.testing.assert_allclose(depth[found.state == BACKGROUND], 7, atol=step)
    surface = found.surface.points
    assert len(surface) == np.sum(found.state == SURFACE) > 20
    # Of a ball of triangles, to a step of depth.
    np.testing.assert_allclose(np.linalg.norm(surface, axis=1), 1, atol=0.004)
    np.testing.assert_allclose(np.round(depth / step), depth / step, atol=1e-6)
    assert found.hidden_share == pytest.approx(0.5, abs=0.02)


def test_what_is_out_of_range_or_hits_nothing_is_unknown(ball):
    rays, rng = grid(), np.random.default_rng(0)
    nothing = World(ball, Surroundings(), 0.5).read(rays, EXACT, rng)
    assert set(np.unique(nothing.state)) == {UNKNOWN, SURFACE}
    assert nothing.hidden_share == 0
    along = (nothing.points - EYE) / (nothing.points - EYE)[:, 1:2]
    np.testing.assert_allclose(along, rays.directions.reshape(-1, 3), atol=1e-12)
    # The wall is 7 units away, the ball 4: beyond nine metres in units of 1.5.
    far = World(ball, Surroundings(planes=WALL), 1.5).read(rays, EXACT, rng)
    np.testing.assert_array_equal(far.state, nothing.state)
    near = World(ball, Surroundings(planes=WALL), 0.05).read(rays, EXACT, rng)
    assert set(np.unique(near.state)) == {UNKNOWN, BACKGROUND}


def test_lost_returns_are_unknown_and_noise_is_in_metres(ball):
    rays, rng = grid(), np.random.default_rng(1)
    lossy = dataclasses.replace(EXACT, dropout=0.3)
    around = Surroundings(planes=WALL)
    found = World(ball, around, 0.5).read(rays, lossy, rng)
    assert np.mean(found.state == UNKNOWN) == pytest.approx(0.3, abs=0.06)
    assert {SURFACE, BACKGROUND} <= set(found.state)
    noisy = dataclasses.replace(EXACT, noise=((0.0, 0.01),))
    for half_extent in (0.2, 1.0):
        world = World(ball, around, half_extent)
        found = world.read(rays, noisy, rng)
        depth = found.points[found.state == BACKGROUND][:, 1] + 5
        directions = rays.directions.reshape(-1, 3)[found.state == BACKGROUND]
        along = (depth - 7) * np.linalg.norm(directions, axis=1) * half_extent
        assert np.std(along) == pytest.approx(0.01, rel=0.1)


def test_rings_are_cones_about_an_axis_that_leave_gaps(ball):
    """Each has one elevation of the sensor, and the ball's middle has `pitch`."""
    eye, pitch = np.array([4.0, 3.0, 2.0]), 0.1
    config = OusterConfig(beams=16, columns=1024, elevation_degrees=(-15.0, 15.0))
    rays = ring_rays(ball, eye, config, pitch)
    forward = -eye / np.linalg.norm(eye)
    level = np.cross(forward, (0, 0, 1.0))
    level /= np.linalg.norm(level)
    axis = np.sin(pitch) * forward + np.cos(pitch) * np.cross(level, forward)
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=-1), 1)
    elevations = np.degrees(np.arcsin(rays.directions @ axis))
    np.testing.assert_allclose(np.ptp(elevations, axis=1), 0, atol=1e-9)
    expected = np.linspace(-15, 15, 16)
    gaps = np.abs(elevations[:, :1] - expected).min(axis=1)
    np.testing.assert_allclose(gaps, 0, atol=1e-9)
    assert np.all(np.diff(elevations[:, 0]) < 0)
    across = np.arccos(np.sum(rays.directions[0, 1:] * rays.directions[0, :-1], -1))
    step = 2 * np.pi / 1024 * np.cos(np.radians(elevations[0, 0]))
    np.testing.assert_allclose(across, step, rtol=1e-3)
    # The ball spans 21 degrees of them: every beam of that meets it.
    hits = ball.cast(eye, rays.directions.reshape(-1, 3))
    rings = np.unique(hits.ray // rays.directions.shape[1])
    half = np.degrees(np.arcsin(1 / np.linalg.norm(eye)))
    meets = np.abs(expected - np.degrees(pitch)) < half
    assert len(rings) == pytest.approx(meets.sum(), abs=1)
