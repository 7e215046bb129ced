"""What would have hidden a measured surface."""

import numpy as np
import pytest

from prism_jax.geometry.cloud import MAX_SIGHTS
from prism_jax.preprocessing.visibility import beside_and_behind, in_front

EYE = np.array([0.0, 0.0, 5.0])
SHIFT = np.array([4e5, 5e6, 100.0])


@pytest.fixture(scope="module")
def plane():
    """At z = 0, as dense as its spacing of 0.05 says."""
    line = np.arange(-20, 21) * 0.05
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def along(heights):
    return np.array([[0.01, 0.02, z] for z in heights])


def test_only_what_is_nearer_by_more_than_the_tolerance(plane):
    found = in_front(along([2.0, 0.21, 0.19, 0.0, -0.3, 6.0]), plane, EYE, 0.05, 4.0)
    assert found.tolist() == [True, True, False, False, False, False]
    # Beside the plane nothing is hidden.
    assert not in_front(np.array([[2.0, 0.0, 1.0]]), plane, EYE, 0.05, 4.0).any()


def test_one_near_point_that_was_measured_in_front_explains_another(plane):
    post, points = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, 1.1]])
    assert in_front(points, plane, EYE, 0.05, 4.0).all()
    both = np.concatenate([plane, post])
    assert not in_front(points, both, EYE, 0.05, 4.0).any()


def test_unit_place_and_more_of_the_same_points_do_not_matter(plane):
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    here = in_front(points, plane, EYE, 0.05, 4.0)
    assert 0.1 < here.mean() < 0.9
    there = in_front(*(1e3 * x + SHIFT for x in (points, plane, EYE)), 50.0, 4.0)
    np.testing.assert_array_equal(here, there)
    # Of a large cloud evenly spaced rows are asked.
    large = np.repeat(plane, 12, axis=0)
    assert len(large) > MAX_SIGHTS
    np.testing.assert_array_equal(in_front(points, large, EYE, 0.05, 4.0), here)


def test_empty_and_degenerate(plane):
    nothing = np.zeros((0, 3))
    assert in_front(nothing, plane, EYE, 0.05, 4.0).shape == (0,)
    assert not in_front(plane, nothing, EYE, 0.05, 4.0).any()
    assert not in_front(EYE[None], plane, EYE, np.inf, 4.0).any()
    assert in_front(along([2.0]), along([0.0]), EYE, 0.05, 4.0).all()


def test_how_far_beside_and_behind(plane):
    """Of the plane's edge at x = 1, and of its middle."""
    points = np.array([[0.0, 0, -1.5], [0, 0, 2.0], [2.0, 0, 0], [0, 0, 5.0]])
    beside, behind = beside_and_behind(points, plane, EYE)
    np.testing.assert_allclose(behind[:2], [1.5, -2.0], atol=1e-9)
    assert (beside[:2] < 1e-9).all()
    apart = np.arctan2(2, 5) - np.arctan2(1, 5)
    assert beside[2] == pytest.approx(2 * np.sin(apart / 2) * np.hypot(1, 5))
    assert np.isfinite(beside).all() and np.isfinite(behind).all()
    there = beside_and_behind(*(1e3 * x + SHIFT for x in (points, plane, EYE)))
    np.testing.assert_allclose(
        np.array(there)[:, :3] / 1e3, [beside[:3], behind[:3]], atol=1e-6
    )
