import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.simulation.views import QUANTUM, make_views, rounded


def test_clouds_fill_their_frame_in_farthest_point_order():
    """Distances to the nearest of all points before shrink, up to the quantum."""
    shape = make_views("mug", 11, 2)
    lower, upper = shape.complete.min(axis=0), shape.complete.max(axis=0)
    np.testing.assert_allclose(lower + upper, 0, atol=2 * QUANTUM)
    assert (upper - lower).max() == pytest.approx(2, abs=2 * QUANTUM)
    for cloud in (shape.partials[1], shape.complete):
        points = cloud[:100].astype(np.float64)
        gaps = [KDTree(points[:n]).query(points[n])[0] for n in range(1, 100)]
        assert np.diff(gaps).max() <= 4 * QUANTUM


def test_coordinates_are_rounded_to_the_nearest_step_and_overflow_is_refused():
    points = np.random.default_rng(0).uniform(-1.9, 1.9, (100, 3))
    exact = rounded(points)
    assert np.abs(exact - points).max() <= QUANTUM / 2 * 1.001
    np.testing.assert_array_equal(rounded(exact), exact)
    for bad in (2.0, np.nan):
        with pytest.raises(ValueError, match="within"):
            rounded(np.array([[0.0, bad, 0.0]]))
