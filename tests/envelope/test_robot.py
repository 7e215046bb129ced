import numpy as np
import pytest
import trimesh
import yourdfpy
from scipy.spatial import KDTree

from prism_jax.envelope import robot
from prism_jax.envelope.robot import (
    joints_from_dict,
    of_robot,
    on_triangles,
    robot_surface,
)
from prism_jax.io.errors import InputError
from prism_jax.robots.urdf import Linkage
from tests.experiments.simulation.roboarm.conftest import model, urdf

__all__ = ["model", "urdf"]
POSITIONS = {"yaw": 0.4, "shoulder": 0.9, "elbow": -1.2}


def test_the_surface_is_where_another_reader_of_urdf_has_it(urdf):
    base = trimesh.transformations.euler_matrix(0.1, -0.3, 1.2)
    base[:3, 3] = 2.0, -1.0, 0.5
    points = robot_surface(Linkage(urdf), POSITIONS | {"else": 1.0}, base, 0.02)
    other = yourdfpy.URDF.load(str(urdf))
    other.update_cfg([POSITIONS[name] for name in other.actuated_joint_names])
    mesh = other.scene.to_geometry()
    mesh.apply_transform(base)
    _, away, _ = trimesh.proximity.closest_point(mesh, points[::7])
    assert away.max() < 1e-9
    sampled, _ = trimesh.sample.sample_surface(mesh, 3000, seed=0)
    assert KDTree(points).query(sampled)[0].max() <= 0.02


@pytest.mark.parametrize("origin", [0.0, 1e6])
def test_no_place_on_triangles_is_farther_than_the_spacing(origin):
    box = trimesh.creation.box((1.0, 0.3, 0.02))
    box.apply_translation((origin, 0, 0))
    for spacing in (0.05, 0.4, 3.0):
        points = on_triangles(box.vertices, box.faces, spacing)
        sampled, _ = trimesh.sample.sample_surface(box, 2000, seed=0)
        assert KDTree(points).query(sampled)[0].max() <= spacing
    assert len(on_triangles(box.vertices, box.faces, 3.0)) <= 8
    assert on_triangles(np.zeros((0, 3)), np.zeros((0, 3), int)).shape == (0, 3)


def test_a_triangle_without_area_is_a_line_or_a_point():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0, 0], [2, 2, 2.0]])
    points = on_triangles(corners, np.array([[0, 1, 2], [3, 3, 3]]), 0.1)
    assert (points[:, 1] == points[:, 2]).all()
    assert KDTree(points).query(np.linspace([0, 0, 0], [1, 0, 0], 50))[0].max() <= 0.1
    assert KDTree(points).query([2, 2, 2])[0] == 0


def test_a_robot_in_millimetres_is_refused_and_a_long_edge_is_not(monkeypatch):
    monkeypatch.setattr(robot, "MAX_POINTS", 20_000)
    thin, face = np.array([[0, 0, 0], [3, 0, 0], [0, 0.01, 0]]), np.array([[0, 1, 2]])
    assert KDTree(on_triangles(thin, face)).query([1.5, 0.0, 0.0])[0] <= 0.02
    with pytest.raises(InputError, match="3,000 m takes over 20,000 points; give"):
        on_triangles(1000 * thin, face)
    # Before memory is taken, a floor's too; and what is far from itself has no cubes.
    monkeypatch.undo()
    floor = trimesh.creation.box((20, 20, 0.1))
    for corners, faces in ((floor.vertices, floor.faces), (thin * [1e6, 1, 1], face)):
        with pytest.raises(InputError, match=r"r.urdf: a link of .* takes over 2,000"):
            on_triangles(corners, faces, path="r.urdf")


def test_points_near_the_surface_are_the_robots():
    surface = np.array([[0.0, 0, 0], [1, 0, 0]])
    points = np.array([[0.02, 0, 0], [0.5, 0, 0], [1, 0.04, 0]])
    assert of_robot(points, surface, 0.03).tolist() == [True, False, False]
    assert of_robot(points, surface[:0]).tolist() == [False] * 3
    assert of_robot(points[:0], surface).shape == (0,)


def test_joints_are_read_with_the_base():
    positions, base = joints_from_dict({"robot": "x", "positions": {"a": 1}})
    assert positions == {"a": 1.0}
    np.testing.assert_array_equal(base, np.eye(4))
    turned = trimesh.transformations.euler_matrix(0.1, 0.2, 0.3)
    content = {"positions": {}, "base": turned.tolist()}
    np.testing.assert_allclose(joints_from_dict(content)[1], turned)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({}, "no joint positions"),
        ({"positions": {"a": "x"}}, "no joint positions"),
        ({"positions": {"a": 1e300}}, "no joint positions"),
        ({"positions": {}, "base": [[10**400] * 4] * 4}, "not a 4x4 pose"),
        ({"positions": {}, "base": 3}, "not a 4x4 pose"),
        ({"positions": {}, "base": np.diag([2.0, 1, 1, 1]).tolist()}, "not a 4x4 pose"),
        ({"positions": {}, "base": [["a"] * 4] * 4}, "not a 4x4 pose"),
    ],
)
def test_joints_that_are_none_are_refused(content, told):
    with pytest.raises(InputError, match=told):
        joints_from_dict(content)
