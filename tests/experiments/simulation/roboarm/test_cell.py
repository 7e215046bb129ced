import numpy as np
import pytest
import trimesh

from experiments.simulation.roboarm.cell import are_hidden, make_cell
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
