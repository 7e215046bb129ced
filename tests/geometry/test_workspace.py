"""Workspace: round trips, precision far away, and cameras that see the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.workspace import Workspace

RNG = np.random.default_rng(0)


TURN = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])


def turned_about(angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def test_the_cube_around_a_cloud():
    points = RNG.uniform([-1, 2, 0], [1, 5, 0.5], (200, 3))
    points[:2] = [[-1, 2, 0], [1, 5, 0.5]]
    workspace = Workspace.from_points(points, margin=1.25)
    assert np.allclose(workspace.center, [0, 3.5, 0.25])
    assert workspace.half_extent == pytest.approx(1.25 * 1.5)
    unit = workspace.to_unit(points)
    assert np.allclose(unit, (points - [0, 3.5, 0.25]) / (1.25 * 1.5))
    assert np.allclose(workspace.from_unit(unit), points)
    assert np.array_equal(Workspace.unit().to_unit(points), points)
    assert np.array_equal(Workspace.unit().from_unit(points), points)
    # NumPy keeps double precision far from the origin.
    far = points + np.array([4e5, 5e6, 100.0])
    assert np.allclose(Workspace.from_points(far, 1.25).to_unit(far), unit, atol=1e-8)


@pytest.mark.parametrize("array", [np.array, jnp.array])
def test_a_cloud_without_extent_and_what_is_refused(array):
    for count in (1, 5):
        point = array([[3.0, 2.0, 1.0]] * count)
        workspace = Workspace.from_points(point)
        assert workspace.half_extent == 1
        assert np.allclose(workspace.to_unit(point), 0)
    with pytest.raises(ValueError, match="empty cloud"):
        Workspace.from_points(point[:0])
    for half_extent in (-1.0, 0.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="half_extent must be positive and finite"):
            Workspace(array([0.0, 0, 0]), array(half_extent))
    for value in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            Workspace.from_points(array([[0.0, 0, 0], [1, value, 0]]))


@pytest.mark.parametrize("rotation", [TURN, turned_about(0.7) @ TURN])
def test_a_turned_cube_holds_the_cloud_along_its_own_axes(rotation):
    points = RNG.uniform([-1, 2, 0], [1, 5, 0.5], (200, 3))
    workspace = Workspace.from_points(points, 1.25, rotation)
    unit = workspace.to_unit(points)
    assert np.allclose(unit.min(0), -unit.max(0))
    assert np.abs(unit).max() == pytest.approx(1 / 1.25)
    assert np.allclose(workspace.from_unit(unit), points, rtol=0, atol=1e-14)
    along = points @ rotation.T
    expected = Workspace.from_points(along, 1.25)
    assert np.allclose(unit, expected.to_unit(along))


def test_cameras_to_a_turned_workspace_and_back():
    """Far from the origin, in double precision."""
    center = np.array([4e5, 5e6, 100.0])
    workspace = Workspace(center, np.array(0.7), turned_about(0.3) @ TURN)
    pose = turned_about(1.1) @ TURN.T
    intrinsics = np.array([[30.0, 0, 15.5], [0, 30, 15.5], [0, 0, 1]])
    camera = Camera(pose, [0, 0, 3.0] - pose @ center, intrinsics, 32, 32)
    points = center + RNG.uniform(-0.5, 0.5, (30, 3))
    there = workspace.camera_to_unit(camera)
    seen = there.to_camera(workspace.to_unit(points)) * 0.7
    assert np.allclose(seen, camera.to_camera(points), rtol=0, atol=1e-8)
    back = workspace.camera_from_unit(there)
    assert np.allclose(back.to_camera(points), camera.to_camera(points), atol=1e-8)
    assert np.allclose(back.rotation, pose, rtol=0, atol=1e-14)


def test_gradients(x64):
    points = jnp.asarray(RNG.normal(size=(6, 3)))

    @jax.jit
    def unit_and_metres(points, workspace):
        unit = workspace.to_unit(points)
        return unit, workspace.from_unit(unit**2)

    workspace = Workspace(jnp.array([0.4, -0.2, 1.5]), jnp.array(0.7))
    check_grads(unit_and_metres, (points, workspace), order=1)
    # What is traced is not refused.
    negative = jax.jit(lambda half: Workspace(jnp.zeros(3), half).to_unit(points))
    assert np.allclose(negative(jnp.array(-2.0)), points / -2)


def test_jit_and_vmap_where_only_marked_points_count():
    clouds = RNG.normal(size=(3, 20, 3)).astype(np.float32)
    marked = np.arange(20) % 7 > 0
    clouds[:, ~marked] *= 1e3

    def normalized(cloud, marked):
        workspace = Workspace.from_points(cloud, where=marked)
        return workspace, workspace.to_unit(cloud)

    workspaces, units = jax.jit(jax.vmap(normalized, (0, None)))(clouds, marked)
    for row, cloud in enumerate(clouds):
        expected = Workspace.from_points(cloud[marked])
        assert np.allclose(workspaces.center[row], expected.center, atol=1e-6)
        assert np.allclose(units[row], expected.to_unit(cloud), rtol=1e-5, atol=1e-6)
        eager, _ = normalized(cloud, marked)
        assert eager.half_extent == expected.half_extent
