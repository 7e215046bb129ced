"""Farthest-point order, and its prefixes."""

import sys

import numpy as np
import pytest

from prism_jax.data.ordering import farthest_point_order, first_points
from prism_jax.io.errors import InputError


def greedy_order(points: np.ndarray, start: int, count: int) -> list[float]:
    """Covering radius before each step of a plain farthest-point loop."""
    gaps = np.sum((points - points[start]) ** 2, axis=1)
    radii = []
    for _ in range(count - 1):
        winner = int(np.argmax(gaps))
        radii.append(gaps[winner])
        gaps = np.minimum(gaps, np.sum((points - points[winner]) ** 2, axis=1))
    return radii


@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_order_is_exactly_farthest_point(offset):
    """Against a NumPy loop from the same first point."""
    points = np.random.default_rng(0).normal(size=(3000, 3)).astype(np.float32)
    points = points * np.float32([1, 0.3, 0.1]) + np.float32(offset)
    order = farthest_point_order(points, 300)
    start = int(np.argmax(np.all(points == order[0], axis=1)))
    expected = greedy_order(points, start, 300)
    gaps = np.sum((points - order[0]) ** 2, axis=1)
    for step, radius in enumerate(expected, 1):
        chosen = np.sum((order[:step] - order[step]) ** 2, axis=1).min()
        assert chosen == pytest.approx(gaps.max(), rel=1e-6)
        assert chosen == pytest.approx(radius, rel=1e-6)
        gaps = np.minimum(gaps, np.sum((points - order[step]) ** 2, axis=1))


def test_short_clouds_repeat_cyclically_and_empty_ones_raise():
    points = np.random.default_rng(1).normal(size=(5, 3))
    order = farthest_point_order(points, 12)
    np.testing.assert_array_equal(order[5:10], order[:5])
    assert len(np.unique(order, axis=0)) == 5
    one = farthest_point_order(points[:1], 3)
    np.testing.assert_array_equal(one, np.repeat(points[:1], 3, axis=0))
    with pytest.raises(ValueError, match="empty"):
        farthest_point_order(points[:0], 3)


def test_duplicates_come_last():
    points = np.random.default_rng(2).normal(size=(50, 3))
    order = farthest_point_order(np.tile(points, (4, 1)), 50)
    assert len(np.unique(order, axis=0)) == 50


def test_of_an_ordered_cloud_the_first_points_are_its_prefix():
    points = np.random.default_rng(3).normal(size=(50, 3))
    np.testing.assert_array_equal(first_points(points, 20, True), points[:20])
    repeated = first_points(points, 60, True)
    np.testing.assert_array_equal(repeated[50:], points[:10])
    expected = farthest_point_order(points, 20)
    np.testing.assert_array_equal(first_points(points, 20, False), expected)


def test_only_an_unordered_cloud_needs_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "fpsample", None)
    points = np.random.default_rng(3).normal(size=(50, 3))
    first_points(points, 20, True)
    with pytest.raises(InputError, match=r"fpsample: not installed; .*\[data\]"):
        first_points(points, 20, False)
