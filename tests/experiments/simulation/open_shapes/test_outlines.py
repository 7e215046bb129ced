import numpy as np
import pytest
from manifold3d import CrossSection
from scipy.interpolate import BSpline
from scipy.spatial import KDTree

from experiments.simulation.open_shapes.outlines import (
    convex_outline,
    outline,
    smooth,
    tightest_bend,
)


def shoelace(points: np.ndarray) -> float:
    x, y = points.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


@pytest.mark.parametrize("draw", [outline, convex_outline])
def test_outlines_are_simple_counter_clockwise_and_span_the_square(draw):
    for seed in range(60):
        points = draw(np.random.default_rng(seed))
        np.testing.assert_allclose(points.min(axis=0), -0.5, atol=1e-12)
        np.testing.assert_allclose(points.max(axis=0), 0.5, atol=1e-12)
        # Of an outline that crossed itself, the parts would not add up.
        area = CrossSection([points]).area()
        assert shoelace(points) == pytest.approx(area, rel=1e-6)
        assert area > 0.05


def test_corners_cut_again_and_again_tend_to_the_b_spline():
    corners = np.random.default_rng(0).normal(size=(6, 2))
    line = smooth(corners, 8)
    ideal = BSpline(np.arange(9.0) - 2, corners, 2)(np.linspace(0, 4, 4000))
    # Before and behind it the line leads straight to the ends, which are kept.
    gaps, _ = KDTree(ideal).query(line[256:1279])
    assert gaps.max() < 2e-3
    np.testing.assert_array_equal(line[[0, -1]], corners[[0, -1]])


def test_the_tightest_bend_is_the_smallest_radius():
    angle = np.linspace(0, 2, 200)[:, None]
    flat = np.zeros_like(angle)
    arc = np.concatenate([np.cos(angle), np.sin(angle), flat], axis=1)
    assert tightest_bend(0.7 * arc) == pytest.approx(0.7, rel=1e-3)
    straight = np.linspace((0, 0, 0), (1, 2, 3), 5)
    assert tightest_bend(straight) > 1e6
    assert tightest_bend(straight[:2]) == np.inf
