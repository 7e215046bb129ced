import numpy as np
import pytest
import trimesh

from experiments.simulation.roboarm.cell import CAMERA_DISTANCE, look_at, make_cell
from experiments.simulation.roboarm.clutter import HIDDEN_IN_A_FRAME, are_hidden
from experiments.simulation.roboarm.furnishings import (
    FIXTURES,
    fence,
    fixture,
    pedestal,
    table,
    together,
    upright,
)
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.roboarm.trajectories import random_trajectory
from prism_jax.geometry.camera import Camera


@pytest.fixture(scope="module")
def cells(model):
    """A robot, and trajectories with their cells."""
    robot = Robot(model)
    made = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        positions = random_trajectory(robot, 4, 3, rng)
        made.append((positions, make_cell(robot, positions, rng, Camera.l515())))
    return robot, made


def inside_boxes(points, meshes):
    """Which points lie in any of the meshes' bounding boxes."""
    inside = [
        np.all((points > mesh.bounds[0]) & (points < mesh.bounds[1]), axis=1)
        for mesh in meshes
    ]
    return np.any(inside, axis=0)


def test_the_robot_touches_nothing_of_its_cell(cells):
    """By the moving links' vertices and the bounding boxes of all pieces."""
    robot, made = cells
    for positions, cell in made:
        for pose in positions:
            arm = robot.mesh(pose)
            moving = np.unique(arm.faces[robot.faces_link > 0])
            points = arm.vertices[moving] + (0, 0, cell.base_height)
            pieces = [
                piece
                for mesh in (cell.fixtures, cell.clutter)
                for piece in mesh.split(only_watertight=False)
            ]
            assert pieces
            assert not inside_boxes(points, pieces).any()
            assert points[:, 2].min() > cell.base_height


def test_everything_stands_on_something(cells):
    """The robot and the fixtures on the support, the rest on the floor or on it too."""
    _, made = cells
    heights = set()
    for _, cell in made:
        assert cell.support.bounds[0, 2] == pytest.approx(0, abs=1e-9)
        tops = np.unique(cell.support.vertices[:, 2].round(6))
        assert np.isclose(tops, cell.base_height, atol=1e-5).any()
        assert np.isclose(tops, cell.fixtures.bounds[0, 2], atol=1e-5).any()
        assert (
            cell.clutter.bounds[0, 2] == pytest.approx(0, abs=1e-5)
            or np.isclose(tops, cell.clutter.bounds[0, 2], atol=1e-5).any()
        )
        heights.add(cell.base_height)
    assert len(heights) == len(made)


def test_the_camera_sees_the_robot_from_where_it_should(cells):
    robot, made = cells
    for positions, cell in made:
        points = robot.probe_points(positions).reshape(-1, 3)
        points = points + (0, 0, cell.base_height)
        eye = np.asarray(cell.camera.position)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        low, high = CAMERA_DISTANCE
        assert low - 0.2 < np.linalg.norm(eye - middle) < high + 0.2
        pixels, depth = cell.camera.project(points)
        size = (cell.camera.width, cell.camera.height)
        seen = np.all((pixels > 0) & (pixels < np.array(size)), axis=1) & (depth > 0)
        assert np.mean(seen) > 0.9


def test_clutter_hides_a_part_of_the_robot(cells):
    robot, made = cells
    shares = []
    for positions, cell in made:
        points = robot.probe_points(positions) + (0, 0, cell.base_height)
        eye = np.asarray(cell.camera.position)
        shares.append(are_hidden(cell.clutter, points, eye) @ robot.probe_weights)
    low, high = HIDDEN_IN_A_FRAME
    within = [((share >= low) & (share <= high)).all() for share in shares]
    assert np.mean(within) > 0.6
    assert 0.15 < np.mean(shares) < 0.55


def test_hidden_is_what_a_wall_shades():
    """A wall one metre away, 1 x 1 m, before points two metres away."""
    wall = trimesh.creation.box((0.02, 1.0, 1.0))
    wall.apply_translation((1.0, 0.0, 0.0))
    y, z = np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-2, 2, 9))
    points = np.stack([np.full(y.size, 2.0), y.ravel(), z.ravel()], axis=1)
    found = are_hidden(wall, points[None], np.zeros(3))[0]
    reach = 0.5 / 0.99 * 2
    expected = (np.abs(y) < reach) & (np.abs(z) < reach)
    np.testing.assert_array_equal(found, expected.ravel())
    # Not what is before the wall.
    assert not are_hidden(wall, points[None] * 0.4, np.zeros(3)).any()


def test_look_at_agrees_with_the_camera():
    eye, target = np.array([1.2, -0.7, 1.5]), np.array([0.1, 0.2, 0.4])
    rotation, translation = look_at(eye, target)
    camera = Camera.look_at(eye, target)
    np.testing.assert_allclose(rotation, camera.rotation, atol=1e-6)
    np.testing.assert_allclose(translation, camera.translation, atol=1e-6)


@pytest.mark.parametrize("kind", FIXTURES)
def test_fixtures_are_solid_pieces_of_the_size_asked_for(kind):
    for seed in range(4):
        solid = fixture(kind, 0.3, np.random.default_rng(seed))
        assert solid.volume() > 1e-5
        assert solid.genus() >= 0 and len(solid.decompose()) == 1
        bounds = np.array(solid.bounding_box())
        assert 0.1 < (bounds[3:5] - bounds[:2]).max() < 0.45


def test_solids_stand_where_they_are_put():
    rng = np.random.default_rng(0)
    solid = upright(fence(1.0, 1.4, rng), np.array([0.4, -0.3, 0.7]), 0.5)
    bounds = np.array(solid.bounding_box())
    np.testing.assert_allclose(bounds[2], 0.7, atol=1e-6)
    np.testing.assert_allclose((bounds[:2] + bounds[3:5]) / 2, (0.4, -0.3), atol=0.03)
    lower, upper = np.array([-0.2, 0.1]), np.array([0.6, 0.9])
    slab = np.array(table(lower, upper, 0.8)[0].bounding_box())
    np.testing.assert_allclose(slab, (*lower, 0.76, *upper, 0.8), atol=1e-6)
    column = [np.array(part.bounding_box()) for part in pedestal(0.6, 0.1)]
    assert max(box[5] for box in column) == pytest.approx(0.6)
    assert min(box[2] for box in column) == pytest.approx(0.0)


def test_together_keeps_the_triangles_in_order():
    cubes = [trimesh.creation.box((1, 1, size)) for size in (1, 2, 3)]
    whole = together(cubes)
    np.testing.assert_array_equal(
        whole.triangles, np.concatenate([cube.triangles for cube in cubes])
    )
    assert len(together([]).faces) == 0
