"""What rays read of a ball, a wall and a plate in closed form, and maps of it."""

import dataclasses

import numpy as np
import pytest
import trimesh

from experiments.simulation.raycast import Scene
from experiments.simulation.readings import Rays, Readings, World, map_of, map_rays
from experiments.simulation.sensors import L515Config
from experiments.simulation.surroundings import Surroundings
from prism_jax.geometry.framing import framing_camera
from prism_jax.geometry.visibility import BACKGROUND, NEARER, SURFACE, UNKNOWN

EXACT = L515Config().exact()
EYE = np.array([0.0, -5.0, 0.0])
WALL = np.array([(0.0, -1, 0, -2)])
"""At y = 2, seen from below."""
TICKS = np.linspace(-0.6, 0.6, 32)
X, Z = (grid.ravel() for grid in np.meshgrid(TICKS, -TICKS))
DIRECTIONS = np.stack([X, np.ones_like(X), Z], axis=-1)
RAYS = Rays(EYE, DIRECTIONS.reshape(32, 32, 3))
"""Of depth one around +y."""
POINTS = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 0.5, 0.8]


@pytest.fixture(scope="module")
def ball() -> Scene:
    return Scene(trimesh.creation.icosphere(4))


def test_states_and_depths_of_an_exact_camera(ball):
    """A plate at y = -3 hides what is right of the middle."""
    plate = Scene(trimesh.creation.box(bounds=[(0, -3.0, -2), (2, -2.9, 2)]))
    world = World(ball, Surroundings(plate, WALL), 0.5)
    found = world.read(RAYS, EXACT, np.random.default_rng(0))
    hidden = (X > 0) & (abs(X) <= 1) & (abs(Z) <= 1)
    # A ray meets the unit ball 5 away where its tangent is below 1 / sqrt(24).
    tangent = np.hypot(X, Z)
    assert np.all(found.state[hidden] == NEARER)
    assert np.all(found.state[~hidden & (tangent < 0.2)] == SURFACE)
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


def test_what_is_out_of_range_hits_nothing_or_is_lost_is_unknown(ball):
    rng = np.random.default_rng(0)
    nothing = World(ball, Surroundings(), 0.5).read(RAYS, EXACT, rng)
    assert set(np.unique(nothing.state)) == {UNKNOWN, SURFACE}
    # The wall is 7 units away, the ball 4: beyond nine metres in units of 1.5.
    around = Surroundings(planes=WALL)
    far = World(ball, around, 1.5).read(RAYS, EXACT, rng)
    np.testing.assert_array_equal(far.state, nothing.state)
    near = World(ball, around, 0.05).read(RAYS, EXACT, rng)
    assert set(np.unique(near.state)) == {UNKNOWN, BACKGROUND}
    lossy = dataclasses.replace(EXACT, dropout=0.3)
    lost = World(ball, around, 0.5).read(RAYS, lossy, rng).state == UNKNOWN
    assert lost.mean() == pytest.approx(0.3, abs=0.06)


def test_noise_is_in_metres(ball):
    rng = np.random.default_rng(1)
    noisy = dataclasses.replace(EXACT, noise=((0.0, 0.01),))
    for half_extent in (0.2, 1.0):
        world = World(ball, Surroundings(planes=WALL), half_extent)
        found = world.read(RAYS, noisy, rng)
        behind = found.state == BACKGROUND
        depth, slant = found.points[:, 1] + 5, np.linalg.norm(DIRECTIONS, axis=1)
        along = ((depth - 7) * slant * half_extent)[behind]
        assert np.std(along) == pytest.approx(0.01, rel=0.1)


def test_in_a_map_surface_comes_first_then_doubt_then_what_is_nearest():
    """Readings of rays through a few pixels, whichever comes first."""
    eye = np.array([2.0, -3.0, 1.0])
    camera = framing_camera(POINTS, eye)
    rays = map_rays(camera, eye).directions.reshape(-1, 5, 3)[:, 0]
    samples = [
        (0, NEARER, 1.0),
        (0, SURFACE, 3.0),
        (0, SURFACE, 2.0),
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
        assert set(np.flatnonzero(found.state)) == set(expected)
        for pixel, (wanted, depth) in expected.items():
            assert found.state.flat[pixel] == wanted
            assert found.depth.flat[pixel] == pytest.approx(depth, rel=1e-6)
        assert np.all(found.depth[found.state == UNKNOWN] == 0)
