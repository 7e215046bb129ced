"""Free space of known shapes."""

import numpy as np
import pytest

from prism_jax.envelope.carving import (
    Carving,
    CloudView,
    DepthView,
    _least,
    carve,
    check_agreement,
    check_conflicts,
    proven,
)
from prism_jax.envelope.voxels import Grid
from prism_jax.geometry.camera import Camera
from prism_jax.io.depth import points_from_depth
from prism_jax.io.errors import InputError

FAR = np.array([400_000.0, -5_000_000.0, 120.0])
"""As survey coordinates have it."""

BODY = 0.1


def camera_at(eye, width=64, height=48, focal=40.0):
    """Looks along +z, x to the right."""
    middle = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2]])
    intrinsics = np.concatenate([middle, [[0, 0, 1.0]]])
    return Camera(np.eye(3), -np.asarray(eye, float), intrinsics, height, width)


def wall_view(eye, distance, camera=None):
    """A wall across the view, seen by every pixel."""
    camera = camera or camera_at(eye)
    depth = np.full((camera.height, camera.width), float(distance))
    return DepthView(depth, camera)


def test_the_least_value_of_rectangles_is_bounded():
    rng = np.random.default_rng(0)
    image = rng.random((23, 37))
    first = rng.integers(0, (23, 37), (200, 2))
    last = np.minimum(first + rng.integers(0, 12, (200, 2)), (22, 36))
    least = _least(image, first, last)
    for (top, left), (bottom, right), value in zip(first, last, least, strict=True):
        inside = image[top : bottom + 1, left : right + 1]
        assert value <= inside.min()
        side = max(inside.shape)
        if min(top, left) >= side and bottom + side < 23 and right + side < 37:
            wide = image[top - side : bottom + side + 1, left - side : right + side + 1]
            assert value >= wide.min()
    assert _least(image, first[:1] - 30, last[:1])[0] == 0.0
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
    free = carve(grid, view, Carving(margin, 0.2))
    middles = grid.centers() - origin
    margin += 0.2
    # Closed form: every corner and a pixel around it within the pyramid, the last one
    # before the wall.
    half = 0.05
    near, end = middles[:, 2] - half, middles[:, 2] + half
    reach = np.abs(middles[:, :2]) + half
    in_view = (reach * 40.0 / near[:, None] < (31, 23)).all(axis=1)
    expected = in_view & (end + margin < 2.0 - 1e-6)
    # Rounding decides what ends at the wall, or at the image's border.
    clear = np.abs(end + margin - 2.0) > 1e-4
    clear &= (np.abs(reach * 40.0 / near[:, None] - (31.0, 23.0)) > 0.01).all(axis=1)
    np.testing.assert_array_equal(free.ravel()[clear], expected[clear])
    assert expected[clear].any()


def test_what_was_not_measured_frees_nothing():
    grid = Grid.over(np.array([-1, -1, 0.5]), np.array([1, 1, 3.5]), 0.1)
    camera = camera_at(np.zeros(3))
    nothing = np.zeros((48, 64))
    assert not carve(grid, DepthView(nothing, camera)).any()
    assert not carve(grid, CloudView(np.zeros((0, 3)), np.zeros(3))).any()
    assert not carve(grid, CloudView(np.ones((1, 3)), np.zeros(3))).any()
    assert not carve(grid, CloudView(np.ones((9, 3)), np.zeros(3))).any()
    behind = camera_at(np.array([0, 0, 9.0]))
    assert not carve(grid, wall_view(None, 2.0, behind)).any()


def test_holes_free_nothing_that_a_body_fits_into():
    """At 1 m a ball of 10 cm covers 2 x 2 pixels of a pitch of 1/40 wherever it is."""
    grid = Grid.over(np.array([-0.3, -0.3, 1]), np.array([0.3, 0.3, 1.1]), 0.1)
    camera = camera_at(np.zeros(3))
    depth = np.full((48, 64), 3.0)
    for lost in (1, 3):
        proves = 0.1 / np.sqrt(2) * 40 / (lost + 1)
        depth[20 : 20 + lost, 30 : 30 + lost] = 0.0
        view = DepthView(depth, camera)
        assert proven(view.depth, 1 / 40, 0.1, False)[20, 30] == pytest.approx(proves)
        inside = carve(grid, view, Carving(0.1, 0.1))
        assert inside.all() == (proves > 1.3)
        assert inside.any()


@pytest.mark.parametrize("origin", [np.zeros(3), FAR])
def test_a_cloud_frees_what_is_before_its_surface_and_nothing_beside_it(origin):
    steps = np.linspace(-0.5, 0.5, 90)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    wall = np.stack([x, y, np.full(x.size, 2.0)], axis=1) + origin
    grid = Grid.over(origin + (-0.8, -0.8, 1), origin + (0.8, 0.8, 2.4), 0.1)
    free = carve(grid, CloudView(wall, origin), Carving(0.05, 0.15))
    middles = grid.centers() - origin
    before = (np.abs(middles[:, :2]).max(axis=1) < 0.15) & (middles[:, 2] < 1.6)
    assert free.ravel()[before].all()
    sight = middles[:, :2] / middles[:, 2:]
    beside = (np.abs(sight).max(axis=1) > 0.3) | (middles[:, 2] > 2.0)
    assert not free.ravel()[beside].any()


@pytest.mark.parametrize(("near", "free"), [(0.5, False), (2.0, True)])
def test_what_is_next_to_a_hole_may_hide_most_of_a_dark_body(near, free):
    """Of a ball of 16 pixels at 1 m that returns nothing 3 columns are in view."""
    camera = camera_at(np.zeros(3), focal=160.0)
    depth = np.full((48, 64), 3.0)
    rows, columns = np.indices(depth.shape)
    depth[np.hypot(rows - 24, columns - 24.5) < 8] = 0.0
    depth[:, :30] = near
    lower = np.array([-0.5 / 160, 0.5 / 160, 1.0]) - 0.001
    grid = Grid.over(lower, lower + 0.002, 0.002)
    found = carve(grid, DepthView(depth, camera), Carving(0.04, BODY))
    assert found.all() == free and found.size == 1


def test_holes_that_touch_at_corners_are_one():
    depth = np.full((20, 20), 3.0)
    depth[[8, 9, 10], [8, 9, 10]] = np.inf
    depth[7, 7] = 0.5
    shown = proven(depth, 1 / 160, BODY, cells=False)
    np.testing.assert_array_equal(shown[[8, 9, 10], [8, 9, 10]], 0.5)


def sphere():
    """A cloud all around, at a distance of 2."""
    points = np.random.default_rng(0).normal(size=(400_000, 3))
    return 2.0 * points / np.linalg.norm(points, axis=1, keepdims=True)


def test_the_nearest_of_a_cell_counts():
    """The first voxel is free but for a point that is thinner than a body."""
    grid = Grid.over(np.array([1.1, -0.05, -0.05]), np.array([1.9, 0.05, 0.05]), 0.1)
    wall, thin = sphere()[::4], np.array([[1.15, 0.001, 0.001]])
    for points in (wall, np.vstack([thin, wall]), np.vstack([wall, thin])):
        free = carve(grid, CloudView(points, np.zeros(3)), Carving(0.04, 0.2))
        assert free[0, 0, 0] == (points is wall)


def test_a_sensor_in_the_middle_frees_all_around_it():
    grid = Grid.over(np.full(3, -1.5), np.full(3, 1.5), 0.1)
    free = carve(grid, CloudView(sphere(), np.zeros(3)), Carving(0.04, 0.2))
    middles = grid.centers()
    clear = np.linalg.norm(middles, axis=1) < 1.5
    clear &= np.hypot(middles[:, 1], middles[:, 2]) > 1.1  # far from the poles
    assert free.ravel()[clear].all() and clear.any()


@pytest.mark.parametrize(
    ("width", "distance"), [(0.02, 1), (0.02, 2), (0.02, 3), (0.1, 2)]
)
def test_a_post_that_returns_nothing_is_not_free(width, distance):
    """Before a wall at 4 m, from a depth image of 640 x 480 and from its cloud."""
    camera = camera_at(np.zeros(3), 640, 480, 460.0)
    column = (np.arange(640) - 319.5) / 460.0 * distance
    depth = np.full((480, 640), 4.0)
    depth[:, np.abs(column - 0.013) <= width / 2] = 0.0
    lower = np.array([-0.2, -0.2, distance - 0.2])
    grid = Grid.over(lower, lower + 0.4)
    cloud = points_from_depth(depth, depth > 0, camera)
    post = np.full((99, 3), [0.013, 0.0, distance])
    post[:, 1] = np.linspace(-0.19, 0.19, 99)
    index = grid.index_of(post)
    image = DepthView(depth, camera)
    for view in (image, CloudView(cloud, np.zeros(3))):
        free = carve(grid, view).ravel()
        assert not free[index].any()
    assert free.any() or distance == 3 or width > 0.02


def test_a_scan_that_its_depth_image_contradicts_is_refused():
    camera = camera_at(np.zeros(3))
    view = wall_view(np.zeros(3), 2.0, camera)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (100, 3))
    points[:, 2] = 2.0
    check_agreement(view, points, Carving())
    fault = "0% of the scan's points lie on the depth image"
    for wrong in (points * 1.1, points + [0, 0, 0.4], points * 1000):
        with pytest.raises(InputError, match=fault):
            check_agreement(view, wrong, Carving())
    grid = Grid.over(np.full(3, -0.5), np.full(3, 0.5), 0.1)
    free, points = np.zeros(grid.shape, bool), points - [0, 0, 2.0]
    check_conflicts(grid, free, points)
    free[:, :, 5] = True
    with pytest.raises(InputError, match="voxels with points are called free"):
        check_conflicts(grid, free, points)
