import itertools

import numpy as np
import pytest

from prism_jax.envelope.voxels import (
    FREE,
    MEASURED,
    PREDICTED,
    ROBOT,
    UNSEEN,
    Carving,
    Grid,
    _count,
    _least,
    carve,
    label,
    view_of_cloud,
    view_of_depth,
)
from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import InputError

FAR = np.array([400_000.0, -5_000_000.0, 120.0])
"""As survey coordinates have it."""


def camera_at(eye, width=64, height=48, focal=40.0):
    """Looks along +z, x to the right."""
    middle = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2]])
    intrinsics = np.concatenate([middle, [[0, 0, 1.0]]])
    return Camera(np.eye(3), -np.asarray(eye, float), intrinsics, height, width)


def wall_view(eye, distance, camera=None):
    """A wall across the view, seen by every pixel."""
    camera = camera or camera_at(eye)
    depth = np.full((camera.height, camera.width), float(distance))
    return view_of_depth(depth, depth > 0, camera)


def test_a_grid_covers_its_box_and_tells_where_points_are():
    grid = Grid.over(np.array([0, 0, 0.0]), np.array([3, 3, 3.0]), 0.04)
    assert grid.shape == (75, 75, 75)
    np.testing.assert_allclose(grid.upper, 3.0)
    np.testing.assert_array_equal(grid.index_of(grid.centers()), np.arange(75**3))
    corners = np.array([*itertools.product((0.0, 3.0), repeat=3)])
    assert (grid.index_of(corners) >= 0).all()
    outside = np.array([[-1e-9, 1, 1], [1, 3.1, 1], [np.nan, 1, 1], [1, 1, np.inf]])
    assert (grid.index_of(outside) == -1).all()


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


def test_a_box_without_extent_is_one_voxel():
    grid = Grid.over(np.ones(3), np.ones(3), 0.5)
    assert grid.shape == (1, 1, 1)
    assert grid.index_of(np.ones((1, 3))).tolist() == [0]


def test_rectangles_are_counted_and_their_least_value_bounded():
    rng = np.random.default_rng(0)
    image = rng.random((23, 37))
    first = rng.integers(0, (23, 37), (200, 2))
    last = np.minimum(first + rng.integers(0, 12, (200, 2)), (22, 36))
    counted = _count(image > 0.5, first, last)
    least = _least(image, first, last)
    for (top, left), (bottom, right), n, value in zip(
        first, last, counted, least, strict=True
    ):
        inside = image[top : bottom + 1, left : right + 1]
        assert n == (inside > 0.5).sum()
        assert value <= inside.min()
        side = max(inside.shape)
        rows = slice(max(top - side, 0), bottom + side + 1)
        assert value >= image[rows, max(left - side, 0) : right + side + 1].min()
    square = np.minimum(first + 7, (22, 36))
    whole = (square - first == 7).all(axis=1)
    exact = _least(image, first[whole], square[whole])
    for (top, left), value in zip(first[whole], exact, strict=True):
        assert value == image[top : top + 8, left : left + 8].min()


@pytest.mark.parametrize("origin", [np.zeros(3), FAR])
@pytest.mark.parametrize("margin", [0.0, 0.15])
def test_free_is_what_lies_before_a_wall_by_the_margin_and_in_view(origin, margin):
    grid = Grid.over(origin + (-1, -1, 0.5), origin + (1, 1, 3.5), 0.1)
    view = wall_view(origin, 2.0)
    free = carve(grid, view, Carving(margin, 1.0))
    middles = grid.centers() - origin
    # Closed form: every corner within the pyramid, the last one before the wall.
    half = 0.05
    near, end = middles[:, 2] - half, middles[:, 2] + half
    reach = np.abs(middles[:, :2]) + half
    in_view = (reach * 40.0 / near[:, None] < (31.5, 23.5)).all(axis=1)
    expected = in_view & (end + margin < 2.0 - 1e-6)
    # Rounding decides what ends at the wall, or at the image's border.
    clear = np.abs(end + margin - 2.0) > 1e-4
    clear &= (np.abs(reach * 40.0 / near[:, None] - (32.0, 24.0)) > 0.51).all(axis=1)
    np.testing.assert_array_equal(free.ravel()[clear], expected[clear])
    assert expected[clear].any()


def test_no_voxel_that_a_sphere_reaches_into_is_free():
    eye, center, radius = np.array([0, 0, -2.0]), np.array([0.1, 0, 0]), 0.4
    camera = camera_at(eye, 160, 120, 150.0)
    rows, columns = np.indices((120, 160))
    across = [(columns - 79.5) / 150, (rows - 59.5) / 150]
    rays = np.stack([*across, np.ones((120, 160))], axis=2)
    # |t r - (c - e)| = radius, the nearer root; a wall behind.
    toward = center - eye
    a, b = (rays**2).sum(2), rays @ toward
    root = b**2 - a * (toward @ toward - radius**2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 5.0)
    grid = Grid.over(np.full(3, -1.0), np.full(3, 1.0), 0.05)
    view = view_of_depth(depth, depth > 0, camera)
    # Between two rays a surface can be a little nearer than on both.
    free = carve(grid, view, Carving(0.005, 0.5)).ravel()
    gap = np.maximum(np.abs(grid.centers() - center) - 0.025, 0.0)
    reached = np.linalg.norm(gap, axis=1) < radius
    assert free.sum() > 0.3 * free.size
    assert not (free & reached).any()
    # Nor is any in its shadow: behind its middle, on the line of sight.
    behind = np.array([[0.1, 0, 0.6], [0.1, 0, 0.9]])
    assert not free[grid.index_of(behind)].any()


def test_what_was_not_measured_frees_nothing():
    grid = Grid.over(np.array([-1, -1, 0.5]), np.array([1, 1, 3.5]), 0.1)
    camera = camera_at(np.zeros(3))
    nothing = np.zeros((48, 64))
    assert not carve(grid, view_of_depth(nothing, nothing > 0, camera)).any()
    assert not carve(grid, view_of_cloud(np.zeros((0, 3)), np.zeros(3))).any()
    assert not carve(grid, view_of_cloud(np.ones((1, 3)), np.zeros(3))).any()
    assert not carve(grid, view_of_cloud(np.ones((9, 3)), np.zeros(3))).any()
    behind = camera_at(np.array([0, 0, 9.0]))
    assert not carve(grid, wall_view(None, 2.0, behind)).any()


def test_the_share_says_how_many_returns_may_be_lost():
    grid = Grid.over(np.array([-0.3, -0.3, 1]), np.array([0.3, 0.3, 1.5]), 0.1)
    view = wall_view(np.zeros(3), 3.0)
    state = np.array(view.state)
    state[::2] = 0  # every second row is lost
    some = view._replace(state=state)
    assert carve(grid, some, Carving(0.0, 0.3)).all()
    assert not carve(grid, some, Carving(0.0, 0.9)).any()


@pytest.mark.parametrize("origin", [np.zeros(3), FAR])
def test_a_cloud_frees_what_is_before_its_surface_and_nothing_beside_it(origin):
    steps = np.linspace(-0.5, 0.5, 60)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    wall = np.stack([x, y, np.full(x.size, 2.0)], axis=1) + origin
    grid = Grid.over(origin + (-0.8, -0.8, 1), origin + (0.8, 0.8, 2.4), 0.1)
    free = carve(grid, view_of_cloud(wall, origin), Carving(0.05, 0.5))
    middles = grid.centers() - origin
    before = (np.abs(middles[:, :2]).max(axis=1) < 0.15) & (middles[:, 2] < 1.8)
    assert free.ravel()[before].all()
    sight = middles[:, :2] / middles[:, 2:]
    beside = (np.abs(sight).max(axis=1) > 0.3) | (middles[:, 2] > 2.0)
    assert not free.ravel()[beside].any()


def test_a_prediction_takes_free_space_and_gives_none_back():
    grid = Grid.over(np.zeros(3), np.array([4, 1, 1.0]), 1.0)
    free = np.array([True, True, False, False]).reshape(4, 1, 1)
    at = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [2.5, 0.5, 0.5], [3.5, 0.5, 0.5]])
    none = np.zeros((0, 3))
    assert label(grid, free, none, none, none).ravel().tolist() == [
        FREE,
        FREE,
        UNSEEN,
        UNSEEN,
    ]
    state = label(grid, free, none, at[[0, 2]], none).ravel()
    assert state.tolist() == [PREDICTED, FREE, PREDICTED, UNSEEN]
    everything = label(grid, free, at[[0]], at, at[[0, 1]]).ravel()
    assert everything.tolist() == [MEASURED, ROBOT, PREDICTED, PREDICTED]
    outside = at + 100.0
    assert (
        label(grid, free, outside, outside, outside)
        == label(grid, free, none, none, none)
    ).all()
