"""Floors and walls against a meshed box, occluders by what they hide."""

import numpy as np
import pytest
import trimesh

from experiments.simulation.raycast import Scene
from experiments.simulation.surroundings import (
    HIDDEN_SHARES,
    Surroundings,
    random_occluder,
)
from tests.experiments.simulation.test_raycast import moeller_trumbore

ROOM = np.array([(0, 0, 1, -2.0), (0, 1, 0, -3.0), (-1, 0, 0, -4.0)])
"""A floor at z = -2, and walls at y = -3 and x = 4."""


@pytest.fixture(scope="module")
def ball() -> Scene:
    return Scene(trimesh.creation.icosphere(3))


def directions(count: int) -> np.ndarray:
    """Of lengths between 0 and 3."""
    return np.random.default_rng(0).normal(size=(count, 3))


def test_planes_are_hit_where_the_sides_of_a_box_are():
    lower, upper = np.array([-50, -3, -2.0]), np.array([4, 50, 50.0])
    box = trimesh.creation.box(bounds=[lower, upper])
    eye, rays = np.array([1.0, -1, 2]), directions(2000)
    expected = Scene(box).cast(eye, rays)
    hits = Surroundings(planes=ROOM).cast(eye, rays)
    near = expected.points.min(axis=1) > -4
    near &= expected.points.max(axis=1) < 49
    assert near.sum() > 500
    kept = np.isin(hits.ray, expected.ray[near])
    for name in ("points", "distances", "cosines"):
        found, given = getattr(hits, name)[kept], getattr(expected, name)[near]
        np.testing.assert_allclose(found, given, atol=1e-4)
    assert np.all(hits.faces == -1)


def test_the_nearest_of_planes_and_occluders_is_hit(ball):
    eye, rays = np.array([0.5, 4.0, 1.0]), directions(2000)
    both = Surroundings(ball, ROOM).cast(eye, rays)
    alone = ball.cast(eye, rays)
    on_ball = both.faces >= 0
    np.testing.assert_array_equal(both.ray[on_ball], alone.ray)
    np.testing.assert_array_equal(both.faces[on_ball], alone.faces)
    np.testing.assert_allclose(both.points[on_ball], alone.points, atol=1e-6)
    # Under the floor nothing of the ball is left.
    sunk = Surroundings(ball, np.array([(0, 0, 1, 1.5)])).cast(eye + [0, 0, 3], rays)
    assert np.all(sunk.faces == -1) and len(sunk.ray) > 500


@pytest.mark.parametrize("other", [None, trimesh.creation.torus(1.0, 0.3)])
def test_occluders_hide_the_share_they_should(ball, other):
    """Found anew by plain NumPy. They differ, and stand before the object."""
    rng = np.random.default_rng(2)
    shares, kinds = [], set()
    for _ in range(30):
        eye = rng.normal(size=3)
        eye *= rng.uniform(2, 6) / np.linalg.norm(eye)
        seen = ball.cast(eye, directions(300) - eye).points
        occluder = random_occluder(eye, seen, rng, other)
        if occluder is None:
            continue
        origins = np.broadcast_to(eye, seen.shape)
        first, _ = moeller_trumbore(occluder.triangles, origins, seen - eye)
        shares.append(np.mean(first < np.linalg.norm(seen - eye, axis=1)))
        kinds.add(len(occluder.triangles))
    assert len(shares) > 25
    assert HIDDEN_SHARES[0] - 0.02 <= min(shares) < 0.3
    assert 0.5 < max(shares) <= HIDDEN_SHARES[1] + 0.02
    # Bars and boxes, a blob, and the torus if there is one.
    assert {12, 24, 320} <= kinds
    assert (other is not None and len(other.faces) in kinds) == (other is not None)
