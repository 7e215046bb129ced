import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.data.examples import QUANTUM, dequantise, make_example, quantise
from prism_jax.data.shapes import make_shape


@pytest.fixture(scope="module")
def example():
    return make_example("mug", 11, 16384)


def test_complete_cloud_fills_the_oracle_frame(example):
    complete = dequantise(example[1])
    lower, upper = complete.min(axis=0), complete.max(axis=0)
    np.testing.assert_allclose(lower + upper, 0, atol=2 * QUANTUM)
    assert (upper - lower).max() == pytest.approx(2, abs=2 * QUANTUM)


def test_partial_lies_on_the_complete_surface(example):
    partial, complete, _ = example
    gaps, _ = KDTree(dequantise(complete)).query(dequantise(partial))
    assert gaps.max() < 0.06
    assert partial.shape == (2048, 3)


def test_partial_sees_one_side_and_the_viewpoint_is_outside(example):
    partial, complete, viewpoint = example
    gaps, _ = KDTree(dequantise(partial)).query(dequantise(complete))
    assert 0.2 < np.mean(gaps > 0.1) < 0.9
    assert 2.5 <= np.linalg.norm(viewpoint) <= 4.0


def test_fewer_complete_points_are_a_prefix(example):
    partial, complete, viewpoint = make_example("mug", 11, 256)
    np.testing.assert_array_equal(partial, example[0])
    np.testing.assert_array_equal(complete, example[1][:256])
    np.testing.assert_array_equal(viewpoint, example[2])


def test_example_uses_the_mesh_of_its_seed(example):
    extents = make_shape("mug", 11).extents
    span = np.ptp(dequantise(example[1]), axis=0)
    np.testing.assert_allclose(span / span.max(), extents / extents.max(), atol=0.01)


def test_quantisation_rounds_to_the_nearest_step_and_refuses_overflow():
    points = np.random.default_rng(0).uniform(-1.9, 1.9, (100, 3))
    error = np.abs(dequantise(quantise(points)) - points)
    assert error.max() <= QUANTUM / 2 * 1.001
    exact = dequantise(quantise(points))
    np.testing.assert_array_equal(dequantise(quantise(exact)), exact)
    for bad in (2.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="within"):
            quantise(np.array([[0.0, bad, 0.0]]))
