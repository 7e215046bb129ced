"""Farthest-point order, and its prefixes."""

import sys

import numpy as np
import pytest

from prism_jax.data.ordering import farthest_point_order, first_points
from prism_jax.io.errors import InputError

POINTS = np.random.default_rng(3).normal(size=(50, 3))


@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_order_is_exactly_farthest_point(offset):
    """Each point is as far from those before it as any point of the cloud."""
    points = np.random.default_rng(0).normal(size=(3000, 3)).astype(np.float32)
    points = points * np.float32([1, 0.3, 0.1]) + np.float32(offset)
    order = farthest_point_order(points, 300)
    gaps = np.sum((points - order[0]) ** 2, axis=1)
    for step in range(1, 300):
        chosen = np.sum((order[:step] - order[step]) ** 2, axis=1).min()
        assert chosen == pytest.approx(gaps.max(), rel=1e-6)
        gaps = np.minimum(gaps, np.sum((points - order[step]) ** 2, axis=1))


def test_short_clouds_repeat_and_duplicates_come_last():
    order = farthest_point_order(POINTS[:5], 12)
    np.testing.assert_array_equal(order[5:10], order[:5])
    assert len(np.unique(order, axis=0)) == 5
    order = farthest_point_order(np.tile(POINTS, (4, 1)), 50)
    assert len(np.unique(order, axis=0)) == 50
    with pytest.raises(ValueError, match="empty"):
        farthest_point_order(POINTS[:0], 3)


def test_only_an_unordered_cloud_is_sampled_and_needs_the_package(monkeypatch):
    expected = farthest_point_order(POINTS, 20)
    np.testing.assert_array_equal(first_points(POINTS, 20, False), expected)
    monkeypatch.setitem(sys.modules, "fpsample", None)
    np.testing.assert_array_equal(first_points(POINTS, 20, True), POINTS[:20])
    repeated = first_points(POINTS, 60, True)
    np.testing.assert_array_equal(repeated[50:], POINTS[:10])
    with pytest.raises(InputError, match=r"fpsample: not installed; .*\[data\]"):
        first_points(POINTS, 20, False)
