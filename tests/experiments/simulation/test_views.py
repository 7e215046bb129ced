import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.simulation import views as examples
from experiments.simulation.views import QUANTUM, make_views, rounded


@pytest.fixture(scope="module")
def shape():
    return make_views("mug", 11, 2)


def test_complete_cloud_fills_the_oracle_frame(shape):
    complete = shape[1]
    assert complete.shape == (16384, 3)
    lower, upper = complete.min(axis=0), complete.max(axis=0)
    np.testing.assert_allclose(lower + upper, 0, atol=2 * QUANTUM)
    assert (upper - lower).max() == pytest.approx(2, abs=2 * QUANTUM)


def test_views_see_a_side_each_from_outside(shape):
    partials, complete, eyes = shape[:3]
    hidden = []
    for partial, eye in zip(partials, eyes, strict=True):
        gaps, _ = KDTree(partial).query(complete)
        hidden.append(gaps > 0.1)
        assert 0.2 < np.mean(hidden[-1]) < 0.9
        assert 2.5 <= np.linalg.norm(eye) <= 4.0
    assert np.mean(hidden[0] != hidden[1]) > 0.1


def test_fewer_views_are_a_prefix(shape):
    partials, complete, eyes = make_views("mug", 11)[:3]
    np.testing.assert_array_equal(partials, shape[0][:1])
    np.testing.assert_array_equal(complete, shape[1])
    np.testing.assert_array_equal(eyes, shape[2][:1])


def test_clouds_are_in_farthest_point_order(shape):
    """Distances to the nearest of all points before shrink, up to the quantum."""
    for cloud in (shape[0][1], shape[1]):
        points = cloud[:300].astype(np.float64)
        gaps = [
            KDTree(points[:count]).query(points[count])[0] for count in range(1, 300)
        ]
        assert np.diff(gaps).max() <= 4 * QUANTUM


def test_a_view_of_too_few_points_is_drawn_again(shape, monkeypatch):
    make, drawn = examples.make_view, []

    def meagre_at_first(*arguments):
        view = make(*arguments)
        drawn.append(view.eye)
        return view._replace(points=view.points[:15]) if len(drawn) < 3 else view

    monkeypatch.setattr(examples, "make_view", meagre_at_first)
    eyes = make_views("mug", 11).eyes
    np.testing.assert_array_equal(eyes[0], drawn[2].astype(np.float32))
    monkeypatch.setattr(examples, "MAX_DRAWS", 2)
    drawn.clear()
    with pytest.raises(ValueError, match="no self_occlusion view of 16 points in 2"):
        make_views("mug", 11)


def test_coordinates_are_rounded_to_the_nearest_step_and_overflow_is_refused():
    points = np.random.default_rng(0).uniform(-1.9, 1.9, (100, 3))
    exact = rounded(points)
    assert np.abs(exact - points).max() <= QUANTUM / 2 * 1.001
    assert np.all(exact.astype(np.float64) / QUANTUM % 1 == 0)
    np.testing.assert_array_equal(rounded(exact), exact)
    for bad in (2.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="within"):
            rounded(np.array([[0.0, bad, 0.0]]))
