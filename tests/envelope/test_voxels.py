import itertools

import numpy as np
import pytest

from prism_jax.envelope.voxels import (
    FREE,
    MEASURED,
    PREDICTED,
    ROBOT,
    UNSEEN,
    Grid,
    label,
)
from prism_jax.io.errors import InputError


def test_a_grid_covers_its_box_and_tells_where_points_are():
    grid = Grid.over(np.array([0, 0, 0.0]), np.array([3, 3, 3.0]), 0.04)
    assert grid.shape == (75, 75, 75)
    np.testing.assert_allclose(grid.upper, 3.0)
    np.testing.assert_array_equal(grid.index_of(grid.centers()), np.arange(75**3))
    corners = np.array([*itertools.product((0.0, 3.0), repeat=3)])
    assert (grid.index_of(corners) >= 0).all()
    outside = np.array([[-1e-9, 1, 1], [1, 3.1, 1], [np.nan, 1, 1], [1, 1, np.inf]])
    assert (grid.index_of(outside) == -1).all()
    one = Grid.over(np.ones(3), np.ones(3), 0.5)  # of a box without extent
    assert one.shape == (1, 1, 1) and one.index_of(np.ones((1, 3))).tolist() == [0]


@pytest.mark.parametrize(
    ("lower", "upper", "voxel", "told"),
    [
        (np.zeros(3), np.ones(3), 0.0, "voxel"),
        (np.zeros(3), np.ones(3), np.nan, "voxel"),
        (np.ones(3), np.zeros(3), 0.1, "not a box"),
        (np.zeros(3), np.full(3, np.inf), 0.1, "not a box"),
        (np.zeros(3), np.full(3, 1e4), 0.01, "voxels"),
    ],
)
def test_a_grid_that_is_none_is_refused(lower, upper, voxel, told):
    with pytest.raises(InputError, match=told):
        Grid.over(lower, upper, voxel)


def test_a_prediction_takes_free_space_and_gives_none_back():
    grid = Grid.over(np.zeros(3), np.array([4, 1, 1.0]), 1.0)
    free = np.array([True, True, False, False]).reshape(4, 1, 1)
    at = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [2.5, 0.5, 0.5], [3.5, 0.5, 0.5]])
    none = np.zeros((0, 3))
    bare = label(grid, free, none, none, none)
    assert bare.ravel().tolist() == [FREE, FREE, UNSEEN, UNSEEN]
    state = label(grid, free, none, at[[0, 2]], none).ravel()
    assert state.tolist() == [PREDICTED, FREE, PREDICTED, UNSEEN]
    everything = label(grid, free, at[[0]], at, at[[0, 1]]).ravel()
    assert everything.tolist() == [MEASURED, ROBOT, PREDICTED, PREDICTED]
    outside = at + 100.0
    assert (label(grid, free, outside, outside, outside) == bare).all()
