import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from prism_jax.simulation import views as examples
from prism_jax.simulation.shapes import make_shape
from prism_jax.simulation.views import QUANTUM, make_views, rounded, views_of


@pytest.fixture(scope="module")
def shape():
    return make_views("mug", 11, 2)


def test_complete_cloud_fills_the_oracle_frame(shape):
    complete = shape[1]
    assert complete.shape == (16384, 3)
    lower, upper = complete.min(axis=0), complete.max(axis=0)
    np.testing.assert_allclose(lower + upper, 0, atol=2 * QUANTUM)
    assert (upper - lower).max() == pytest.approx(2, abs=2 * QUANTUM)


def test_partials_lie_on_the_complete_surface(shape):
    partials, complete, _ = shape
    assert partials.shape == (2, 2048, 3)
    for partial in partials:
        gaps, _ = KDTree(complete).query(partial)
        assert gaps.max() < 0.06


def test_views_see_a_side_each_from_outside(shape):
    partials, complete, eyes = shape
    hidden = []
    for partial, eye in zip(partials, eyes, strict=True):
        gaps, _ = KDTree(partial).query(complete)
        hidden.append(gaps > 0.1)
        assert 0.2 < np.mean(hidden[-1]) < 0.9
        assert 2.5 <= np.linalg.norm(eye) <= 4.0
    assert np.mean(hidden[0] != hidden[1]) > 0.1


def test_fewer_views_are_a_prefix(shape):
    partials, complete, eyes = make_views("mug", 11)
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
    make, drawn = examples.make_partial, []

    def meagre_at_first(*arguments):
        points, eye = make(*arguments)
        drawn.append(eye)
        return (points[:15] if len(drawn) < 3 else points), eye

    monkeypatch.setattr(examples, "make_partial", meagre_at_first)
    _, _, eyes = make_views("mug", 11)
    np.testing.assert_array_equal(eyes[0], drawn[2].astype(np.float32))
    monkeypatch.setattr(examples, "MAX_DRAWS", 2)
    drawn.clear()
    with pytest.raises(ValueError, match="no self_occlusion view of 16 points in 2"):
        make_views("mug", 11)


def test_kinds_of_partials_differ_and_the_shape_does_not(shape):
    partials, complete, _ = make_views("mug", 11, 1, "crop")
    np.testing.assert_array_equal(complete, shape[1])
    assert not np.array_equal(partials[0], shape[0][0])


def test_a_mesh_of_any_place_and_size_is_viewed_in_the_same_frame_and_left_alone():
    mesh = trimesh.creation.box((1, 2, 4)).apply_translation((50, 60, 70))
    before = mesh.vertices.copy()
    partials, complete, _ = views_of(mesh, np.random.default_rng(0), 2)
    np.testing.assert_array_equal(mesh.vertices, before)
    spans = np.ptp(complete, axis=0)
    np.testing.assert_allclose(spans, (0.5, 1, 2), atol=0.01)
    gaps, _ = KDTree(complete).query(partials.reshape(-1, 3))
    assert gaps.max() < 0.06


def test_example_uses_the_mesh_of_its_seed(shape):
    extents = make_shape("mug", 11).extents
    span = np.ptp(shape[1], axis=0)
    np.testing.assert_allclose(span / span.max(), extents / extents.max(), atol=0.01)


def test_any_mesh_has_views_and_stays_as_it_was():
    box = trimesh.creation.box((3.0, 2.0, 1.0))
    box.apply_translation((10.0, 0.0, -4.0))
    before = box.vertices.copy()
    partials, complete, _ = views_of(box, np.random.default_rng(0))
    np.testing.assert_array_equal(box.vertices, before)
    faces = np.array([1.0, 2 / 3, 1 / 3])
    for cloud in (complete, partials[0]):
        np.testing.assert_allclose(np.abs(cloud / faces).max(axis=1), 1, atol=0.01)


def test_coordinates_are_rounded_to_the_nearest_step_and_overflow_is_refused():
    points = np.random.default_rng(0).uniform(-1.9, 1.9, (100, 3))
    exact = rounded(points)
    assert np.abs(exact - points).max() <= QUANTUM / 2 * 1.001
    assert np.all(exact.astype(np.float64) / QUANTUM % 1 == 0)
    np.testing.assert_array_equal(rounded(exact), exact)
    for bad in (2.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="within"):
            rounded(np.array([[0.0, bad, 0.0]]))
