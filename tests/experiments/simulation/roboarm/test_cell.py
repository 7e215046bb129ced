import numpy as np
import pytest
import trimesh

from experiments.simulation.roboarm.cell import make_cell
from experiments.simulation.roboarm.clutter import HIDDEN_IN_A_FRAME, are_hidden
from experiments.simulation.roboarm.furnishings import (
    together,
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


def test_together_keeps_the_triangles_in_order():
    cubes = [trimesh.creation.box((1, 1, size)) for size in (1, 2, 3)]
    whole = together(cubes)
    np.testing.assert_array_equal(
        whole.triangles, np.concatenate([cube.triangles for cube in cubes])
    )
    assert len(together([]).faces) == 0
