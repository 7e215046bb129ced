"""Workspace: round trips, precision far away, and cameras that see the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from prism_jax.geometry import Camera, Workspace, render_depth

RNG = np.random.default_rng(0)
render = jax.jit(render_depth)
WORKSPACE = Workspace(jnp.array([0.4, -0.2, 1.5]), jnp.array(0.7))


def test_unit_and_back():
    points = jnp.asarray(RNG.normal(size=(50, 3)), jnp.float32)
    unit = WORKSPACE.to_unit(points)
    expected = (np.asarray(points) - [0.4, -0.2, 1.5]) / 0.7
    assert np.allclose(unit, expected, atol=1e-6)
    assert np.allclose(WORKSPACE.from_unit(unit), points, atol=1e-6)


def test_from_points_is_the_padded_bounding_cube():
    points = RNG.uniform([-1, 2, 0], [1, 5, 0.5], (200, 3))
    points[:2] = [[-1, 2, 0], [1, 5, 0.5]]
    workspace = Workspace.from_points(points, margin=1.25)
    assert np.allclose(workspace.center, [0, 3.5, 0.25])
    assert workspace.half_extent == pytest.approx(1.25 * 1.5)
    unit = workspace.to_unit(points)
    assert np.abs(unit).max() == pytest.approx(1 / 1.25)


def test_from_bounds_takes_plain_lists():
    workspace = Workspace.from_bounds([0.0, 0, 0], [2.0, 1, 4])
    assert np.allclose(workspace.center, [1, 0.5, 2])
    assert workspace.half_extent == pytest.approx(2.0)


@pytest.mark.parametrize("array", [np.array, jnp.array])
@pytest.mark.parametrize("count", [1, 5])
def test_a_cloud_without_extent_gets_a_unit_half_side(array, count):
    point = array([[3.0, 2.0, 1.0]] * count)
    workspace = Workspace.from_points(point)
    assert workspace.half_extent == 1
    assert np.allclose(workspace.to_unit(point), 0)


@pytest.mark.parametrize("array", [np.zeros, jnp.zeros])
def test_an_empty_cloud_is_refused(array):
    with pytest.raises(ValueError, match="empty cloud"):
        Workspace.from_points(array((0, 3)))


def test_numpy_keeps_double_precision_far_from_the_origin():
    near = RNG.normal(size=(100, 3))
    far = near + np.array([4e5, 5e6, 100.0])
    expected = Workspace.from_points(near).to_unit(near)
    assert np.allclose(Workspace.from_points(far).to_unit(far), expected, atol=1e-8)


def test_camera_to_unit_sees_the_same_pixels():
    camera = Camera.look_at((2.0, 1.0, 2.5), WORKSPACE.center, height=32, width=40)
    points = jnp.asarray(RNG.uniform(-0.7, 0.7, (300, 3)), jnp.float32)
    points = points + WORKSPACE.center
    depth, mask = render(points, camera)
    unit_camera = WORKSPACE.camera_to_unit(camera)
    unit_depth, unit_mask = render(WORKSPACE.to_unit(points), unit_camera)
    assert mask.sum() > 50 and np.array_equal(mask, unit_mask)
    assert np.allclose(unit_depth, np.asarray(depth) / 0.7, atol=1e-5)
    assert np.allclose(
        unit_camera.position, WORKSPACE.to_unit(camera.position), atol=1e-5
    )


def test_gradients(x64):
    points = jnp.asarray(RNG.normal(size=(6, 3)))

    @jax.jit
    def unit_and_metres(points, workspace):
        unit = workspace.to_unit(points)
        return unit, workspace.from_unit(unit**2)

    workspace = Workspace(jnp.array([0.4, -0.2, 1.5]), jnp.array(0.7))
    check_grads(unit_and_metres, (points, workspace), order=1)


def test_jit_and_vmap():
    clouds = jnp.asarray(RNG.normal(size=(3, 20, 3)), jnp.float32)

    def normalized(cloud):
        workspace = Workspace.from_points(cloud)
        return workspace, workspace.to_unit(cloud)

    workspaces, units = jax.jit(jax.vmap(normalized))(clouds)
    assert workspaces.center.shape == (3, 3) and workspaces.half_extent.shape == (3,)
    for cloud, unit in zip(clouds, units, strict=True):
        assert np.allclose(unit, normalized(cloud)[1], atol=1e-6)
