"""What stands around an object and cuts it off."""

import numpy as np
import trimesh

from experiments.simulation.raycast import Scene
from experiments.simulation.readings import Readings
from experiments.simulation.surroundings import Surroundings
from experiments.simulation.truncation import Cut
from prism_jax.geometry.visibility import BACKGROUND, NEARER, SURFACE, UNKNOWN

ROOM = np.array([(0, 0, 1, -2.0), (0, 1, 0, -3.0), (-1, 0, 0, -4.0)])
"""A floor at z = -2, and walls at y = -3 and x = 4."""
RAYS = np.random.default_rng(0).normal(size=(2000, 3))
SLAB = np.array([(0.0, 1, 0, 1), (0, -1, 0, 1), (1, 0, 0, 2), (-1, 0, 0, 2)])
"""What is kept lies within |y| <= 1 and |x| <= 2."""


def test_the_nearest_of_planes_and_occluders_is_hit():
    ball = Scene(trimesh.creation.icosphere(3))
    eye = np.array([0.5, 4.0, 1.0])
    both, alone = Surroundings(ball, ROOM).cast(eye, RAYS), ball.cast(eye, RAYS)
    on_ball = both.faces >= 0
    np.testing.assert_array_equal(both.ray[on_ball], alone.ray)
    np.testing.assert_array_equal(both.faces[on_ball], alone.faces)
    np.testing.assert_allclose(both.points[on_ball], alone.points, atol=1e-6)
    # Under the floor nothing of the ball is left.
    sunk = Surroundings(ball, np.array([(0, 0, 1, 1.5)])).cast(eye + [0, 0, 3], RAYS)
    assert np.all(sunk.faces == -1) and len(sunk.ray) > 500


def test_what_is_known_outside_a_cut_hides_the_inside_or_lies_beyond():
    """Along y from the eye: before the slab, in it, behind it; beside it, along a ray
    that never enters it; something nearer and a wall outside; and nothing."""
    eye = np.array([0.0, -5.0, 0.0])
    points = [(0, -3, 0), (0, 0, 0), (1, 3, 0), (3, 0, 0), (0, -4, 0), (0, 9, 0), eye]
    states = np.array([SURFACE] * 4 + [NEARER, BACKGROUND, UNKNOWN], np.uint8)
    readings = Readings(states, np.array(points, np.float64), 0.25)
    found = Cut(SLAB, known=True).apply(readings, eye)
    expected = [NEARER, SURFACE, BACKGROUND, BACKGROUND, NEARER, BACKGROUND, UNKNOWN]
    np.testing.assert_array_equal(found.state, expected)
    np.testing.assert_array_equal(found.points, readings.points)
    # Rays along the sides at |x| = 2 enter only between them.
    for x, state in ((1.0, NEARER), (3.0, BACKGROUND)):
        eye, points = np.array([x, -5.0, 0.0]), np.array([(x, -3.0, 0)])
        beside = Readings(states[:1], points, 0.0)
        assert Cut(SLAB, known=True).apply(beside, eye).state == state
