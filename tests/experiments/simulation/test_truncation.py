"""Cuts: which points stay, and what becomes of pixels that looked at the others."""

import numpy as np
import trimesh

from experiments.simulation.raycast import Scene
from experiments.simulation.readings import Readings
from experiments.simulation.truncation import KEPT_SHARES, Cut, random_cut
from prism_jax.geometry.visibility import BACKGROUND, NEARER, SURFACE, UNKNOWN

EYE = np.array([0.0, -5.0, 0.0])
SLAB = np.array([(0.0, 1, 0, 1), (0, -1, 0, 1), (1, 0, 0, 2), (-1, 0, 0, 2)])
"""What is kept lies within |y| <= 1 and |x| <= 2."""


def readings() -> Readings:
    """Along y from the eye: before the slab, in it, behind it; beside it, along a ray
    that never enters it; something nearer and a wall outside; and nothing."""
    points = [(0, -3, 0), (0, 0, 0), (1, 3, 0), (3, 0, 0), (0, -4, 0), (0, 9, 0), EYE]
    states = [SURFACE] * 4 + [NEARER, BACKGROUND, UNKNOWN]
    return Readings(np.array(states, np.uint8), np.array(points, np.float64), 0.25)


def test_what_is_known_outside_hides_the_inside_or_lies_beyond():
    found = Cut(SLAB, known=True).apply(readings(), EYE)
    expected = [NEARER, SURFACE, BACKGROUND, BACKGROUND, NEARER, BACKGROUND, UNKNOWN]
    np.testing.assert_array_equal(found.state, expected)
    np.testing.assert_array_equal(found.points, readings().points)
    assert found.hidden_share == 0.25


def test_a_ray_along_a_side_enters_only_if_it_is_within():
    """Parallel to the sides at |x| <= 2."""
    beside = Readings(np.full(2, SURFACE, np.uint8), np.array([(1.0, -3, 0)] * 2), 0.0)
    for x, state in ((1.0, NEARER), (3.0, BACKGROUND)):
        eye = np.array([x, -5.0, 0.0])
        points = np.array([(x, -3.0, 0)] * 2)
        found = Cut(SLAB, known=True).apply(beside._replace(points=points), eye)
        assert np.all(found.state == state)


def test_random_cuts_leave_their_share_and_are_of_three_sorts():
    """Edges of an image pass through the eye; a half space is one plane, a box six."""
    scene = Scene(trimesh.creation.icosphere(3))
    rng = np.random.default_rng(0)
    kept, sorts = [], set()
    for _ in range(150):
        eye = rng.normal(size=3)
        eye *= 4 / np.linalg.norm(eye)
        seen = scene.cast(eye, rng.normal(size=(400, 3)) * 0.4 - eye).points
        cut = random_cut(scene, eye, seen, rng)
        inside = cut.holds(seen)
        kept.append(inside.mean())
        count = len(cut.planes)
        at_eye = np.allclose(cut.planes[:, :3] @ eye, cut.planes[:, 3])
        sort = "image" if at_eye else "half space" if count == 1 else "box"
        sorts.add((sort, cut.known))
        assert count in {"image": (1, 2), "half space": (1,), "box": (6,)}[sort]
        if sort == "box":
            normals = cut.planes[:, :3]
            np.testing.assert_allclose(np.abs(normals @ normals.T).sum(0), 2)
            np.testing.assert_allclose(normals.sum(axis=0), 0, atol=1e-9)
    expected = {
        ("image", False),
        *((s, k) for s in ("half space", "box") for k in (0, 1)),
    }
    assert sorts == expected
    assert KEPT_SHARES[0] <= min(kept) < 0.35
    assert 0.75 < max(kept) <= KEPT_SHARES[1] + 1 / 30
