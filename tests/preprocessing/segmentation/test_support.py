"""The plane that objects stand on, and the way up."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prism_jax.io.clouds import read_points
from prism_jax.preprocessing.segmentation.planes import Thinned
from prism_jax.preprocessing.segmentation.support import find_support, find_up

EYE = np.array([0.4, 3.0, 2.5])
TILT = Rotation.from_rotvec(np.deg2rad(36) * np.array([0.8, 0.6, 0])).as_matrix()
Z = np.array([0.0, 0, 1])


def view_of_box(size, center, count, seed=0):
    """The top and the two sides of a cuboid that the sensor sees."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(3, size=count)
    points[np.arange(count), face] = 1
    return 0.5 * points * size + center


def table(side, spacing=0.03, noise=0.005, center=(0, 0), seed=0):
    """A square of z = 0."""
    rng = np.random.default_rng(seed)
    count = int((side / spacing) ** 2)
    points = rng.uniform(-0.5, 0.5, (count, 3)) * [side, side, 0]
    points[:, 2] = noise * rng.normal(size=count)
    return points + [*center, 0]


def chair():
    """A seat, a back at its rear end, and four legs."""
    rng = np.random.default_rng(0)
    seat = rng.uniform(-0.5, 0.5, (900, 3)) * [1, 1, 0.0]
    back = rng.uniform(-0.5, 0.5, (700, 3)) * [1, 0, 1] + [0, -0.5, 0.5]
    leg = rng.uniform(-0.5, 0.5, (60, 3)) * [0.05, 0.05, 0.9] - [0, 0, 0.5]
    legs = [leg + [x, y, 0] for x in (-0.45, 0.45) for y in (-0.45, 0.45)]
    return np.concatenate([seat, back, *legs])


def angle(one, other):
    return np.rad2deg(np.arccos(np.clip(one @ other, -1, 1)))


@pytest.fixture(scope="module")
def scene():
    return np.concatenate([view_of_box([1, 0.8, 0.6], [0.2, 0, 0.3], 1500), table(2.5)])


@pytest.mark.parametrize("unit", [1, 1000])
def test_a_tilted_table_says_which_way_is_up(scene, unit):
    origin = (unit - 1) * np.array([5e2, 5.4e3, 0.3])
    up = find_up(unit * scene @ TILT.T + origin, unit * TILT @ EYE + origin, np.eye(3))
    assert up.source == "support"
    assert angle(up.vector, TILT @ Z) < 0.3


@pytest.mark.parametrize(("side", "noise"), [(1.6, 0), (1.6, 0.01), (6, 0.02)])
def test_tables_of_any_width(side, noise):
    box = view_of_box([1, 0.8, 0.6], [0, 0, 0.3], 1500)
    points = np.concatenate([box, table(side, noise=noise)]) @ TILT.T
    plane = find_support(points, TILT @ EYE)
    assert angle(plane.normal, TILT @ Z) < 0.5
    on_table = np.abs(plane.height(points[1500:])) <= plane.tolerance
    assert on_table.mean() > 0.98
    assert (plane.height(points[:1500]) > plane.tolerance).mean() > 0.9


@pytest.mark.parametrize("sensor", [EYE, None])
def test_no_face_of_a_box_is_a_support(sensor):
    for size in [(1, 1, 1), (2, 1.5, 0.2), (0.2, 2, 2)]:
        assert find_support(view_of_box(size, [0, 0, 0], 2000), sensor) is None


def test_neither_is_a_chairs_seat_nor_a_table_without_anything_on_it():
    for turn in (np.eye(3), TILT):
        assert find_support(chair() @ turn.T, turn @ EYE) is None
    top = table(1.5, noise=0)
    assert find_support(np.concatenate([top, chair()[1600:]]), EYE) is None
    assert find_support(table(3), EYE) is None
    # A low back along the seat's rear end is joined to it, and stands on nothing.
    low = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 3)) * [1.5, 0, 0.3]
    assert find_support(np.concatenate([top, low + [0, -0.75, 0.15]]), EYE) is None


def test_what_is_below_is_no_object_on_it(scene):
    """The same scene, seen from under a table of glass."""
    assert find_support(scene, EYE * [1, 1, -1]) is None


def test_without_a_sensor_objects_are_on_the_side_of_z(scene):
    assert find_support(scene @ TILT.T).normal @ TILT @ Z > 0.9999
    on_its_side = scene @ np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]).T
    assert find_support(on_its_side) is None
    assert find_support(on_its_side, [3.0, 1, 0]) is not None
    assert find_support(scene, np.full(3, np.nan)) is not None


def test_without_a_support_the_camera_says_it_and_then_z():
    box = view_of_box([1, 0.8, 0.6], [0, 0, 0], 1500)
    rotation = Rotation.from_rotvec([0.4, 1, -0.3]).as_matrix()
    up = find_up(box, EYE, rotation)
    # The camera sees up as -y of its image.
    np.testing.assert_allclose(rotation @ up.vector, [0, -1, 0], atol=1e-12)
    assert up.source == "camera"
    up = find_up(box, EYE)
    assert up.source == "z" and np.array_equal(up.vector, Z)


def test_a_camera_tells_a_wall_where_it_also_sees_a_floor(scene):
    """What is a table for one camera is a wall for one that is turned."""
    upright, turned = np.diag([1.0, -1, 1])[[0, 2, 1]], np.diag([1.0, -1, -1])
    floor = table(2.5)[:, [0, 2, 1]] + [0, -1.25, 1.25]
    for points, tables in ((scene, 2), (np.concatenate([scene, floor]), 1)):
        found = [find_support(points, EYE, camera) for camera in (upright, turned)]
        flat = [plane is not None and plane.normal @ Z > 0.99 for plane in found]
        assert flat == [True, tables == 2]


def test_clouds_without_a_plane():
    line = np.outer(np.arange(300.0), [1, 2, 3])
    triangle = np.repeat(np.eye(3), 100, axis=0)
    for points in (np.zeros((0, 3)), np.ones((500, 3)), line, triangle):
        assert Thinned(points).planes == []
        assert find_up(points, EYE).source == "z"


@pytest.mark.parametrize(
    "name", ["kitti/frame_0_car_0.pcd", "shapenet/airplane_partial_2048.ply"]
)
def test_a_scanned_object_is_no_support(real, name):
    for sensor in (np.zeros(3), None):
        assert find_support(read_points(real(name)), sensor) is None


def test_a_scanned_table_is_one(real):
    up = find_up(read_points(real("kinect/mosd_test24.pcd")), np.zeros(3))
    assert up.source == "support"
    # The plane of the points that are labelled as the table.
    assert angle(up.vector, np.array([-0.00988, -0.80737, -0.58996])) < 0.2


def test_no_wall_of_a_room_is_taken_for_the_floor(real):
    points = np.load(real("ouster/single_frame_zm_scan0.npz"))["xyz"]
    up = find_up(points.astype(float), np.zeros(3))
    assert angle(up.vector, Z) < 5
