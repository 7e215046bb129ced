"""Camera: against SciPy rotations, loops and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from prism_jax.geometry.camera import MIN_DEPTH, Camera

RNG = np.random.default_rng(0)


def posed_camera(seed: int = 0, height: int = 12, width: int = 16) -> Camera:
    rng = np.random.default_rng(seed)
    return Camera(
        rotation=jnp.asarray(Rotation.random(rng=rng).as_matrix()),
        translation=jnp.asarray(rng.normal(size=3) + [0, 0, 6.0]),
        intrinsics=jnp.array([[11.0, 0.3, 7.2], [0.0, 13.0, 5.9], [0.0, 0.0, 1.0]]),
        height=height,
        width=width,
    )


def looped_projection(points, camera):
    uv, depth = [], []
    rotation, translation, k = (
        np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(camera)
    )
    for point in np.asarray(points, np.float64):
        x, y, z = rotation @ point + translation
        u = k[0, 0] * x / z + k[0, 1] * y / z + k[0, 2]
        uv.append([u, k[1, 1] * y / z + k[1, 2]])
        depth.append(z)
    return np.array(uv), np.array(depth)


def test_projection_agrees_with_a_loop_and_can_be_mapped():
    cameras = [posed_camera(seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *cameras)
    points = jnp.asarray(RNG.uniform(-1, 1, (40, 3)), jnp.float32)
    uv, z = jax.jit(jax.vmap(Camera.project, in_axes=(0, None)))(stacked, points)
    for i, camera in enumerate(cameras):
        expected_uv, expected_z = looped_projection(points, camera)
        assert np.allclose(uv[i], expected_uv, atol=1e-4)
        assert np.allclose(z[i], expected_z, atol=1e-5)
        at_eye = camera.to_camera(stacked.position[i][None])
        assert np.allclose(at_eye, 0, atol=1e-5)


def test_gradients(x64):
    """Of points, cameras, and what a camera looks at."""

    @jax.jit
    def everything(points, camera, eye, target, fov):
        aimed = Camera.look_at(eye, target, fov_degrees=fov)
        pose = aimed.rotation, aimed.translation, aimed.intrinsics
        return camera.project(points), pose

    points = jnp.asarray(RNG.uniform(-1, 1, (5, 3)))
    eye, target = jnp.array([2.0, 1.0, 0.5]), jnp.array([0.1, 0.2, 0.3])
    given = points, posed_camera(), eye, target
    check_grads(everything, (*given, jnp.array(50.0)), order=1)


def test_points_without_an_image_stay_finite():
    camera = Camera.look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, -2.0, 0.1]])
    uv, z = camera.project(points)
    assert np.all(np.isfinite(uv)) and np.all(z <= MIN_DEPTH)
    gradient = jax.jit(jax.grad(lambda p: camera.project(p)[0].sum()))(points)
    assert np.all(np.isfinite(gradient))
    uv, z = camera.project(jnp.zeros((0, 3)))
    assert uv.shape == (0, 2) and z.shape == (0,)


def test_look_at():
    """Also straight up and down, and where eye and target are one."""
    eyes = [(3.0, 0, 0), (0.3, -2, 1), (0, 0, 2.0), (0, 0, -2.0), (1.0, 1, 1)]
    targets = [(0.0, 0, 0), (0.1, 0.2, -0.3), (0, 0, 0.0), (0, 0, 0.0), (1.0, 1, 1)]
    eyes, targets = np.array(eyes, np.float32), np.array(targets, np.float32)
    look_at = jax.vmap(lambda *at: Camera.look_at(*at, height=48, width=64))
    cameras = jax.jit(look_at)(eyes, targets)
    assert np.allclose(cameras.position, eyes, atol=1e-5)
    rotations = np.asarray(cameras.rotation, np.float64)
    same = rotations @ rotations.transpose(0, 2, 1)
    assert np.allclose(same, np.eye(3), atol=1e-6)
    assert np.allclose(np.linalg.det(rotations), 1, atol=1e-5)
    uv, z = jax.vmap(Camera.project)(cameras, targets[:, None])
    assert np.allclose(uv[:4], [31.5, 23.5], atol=1e-3)
    distance = np.linalg.norm(eyes - targets, axis=1)
    assert np.allclose(z[:4, 0], distance[:4], rtol=1e-5)


def test_axes_and_field_of_view_of_an_image():
    """Looking along +x with z up, -y is to the right."""
    camera = Camera.look_at((-2.0, 0.0, 0.0), (0.0, 0, 0), fov_degrees=90, height=100)
    points = jnp.array([[0.0, 0, -2], [0.0, 0, 2], [0.0, 0, 0], [0.0, -1, 0]])
    uv = np.asarray(camera.project(points)[0])
    assert np.allclose(uv[:3, 1], [99.5, -0.5, 49.5], atol=1e-3)
    assert uv[3, 0] > uv[2, 0] + 1


def test_framing_fills_the_view_with_the_points():
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform(-0.3, 0.3, (50, 3)) + [0.5, 0, 0], jnp.float32)
    eye = jnp.array([3.0, -1.0, 0.5])
    framing = jax.jit(Camera.framing, static_argnums=2)
    camera = framing(points, eye, 1.25)
    uv, depth = looped_projection(points, camera)
    np.testing.assert_allclose(camera.position, eye, atol=1e-5)
    assert (depth > 0).all()
    # The outermost point lies at 1 / margin of the half width from the centre.
    np.testing.assert_allclose(np.abs(uv - 63.5).max(), 64 / 1.25, rtol=1e-4)
    # From inside the cloud, and of one place, the view has a widest and a least angle.
    inside = framing(points, points.mean(0), 1.25)
    half_angle = np.arctan(64.0 / np.asarray(inside.intrinsics)[0, 0])
    np.testing.assert_allclose(np.rad2deg(half_angle), 60.0, rtol=1e-4)
    one = framing(jnp.ones((50, 3)), jnp.zeros(3), 1.25)
    assert np.isfinite(np.asarray(one.intrinsics)).all()


@pytest.mark.parametrize("xp", [np, jnp])
def test_pixels_are_counted_row_by_row_and_one_past_the_last_is_none(xp):
    camera = posed_camera()
    points = np.random.default_rng(0).uniform(-3, 3, (300, 3)).astype(np.float32)
    points[:2] = [[np.nan] * 3, [np.inf, 0, 0]]
    points[2] = camera.position
    camera = jax.tree.map(xp.asarray, camera)
    pixel, depth = camera.pixel_of(xp.asarray(points))
    assert isinstance(pixel, jax.Array) == (xp is jnp)
    uv, z = looped_projection(np.nan_to_num(points, posinf=0), camera)
    column, row = np.floor(uv + 0.5).T
    inside = (z > MIN_DEPTH) & (column >= 0) & (column < 16) & (row >= 0) & (row < 12)
    inside[:3] = False
    assert 20 < inside.sum() < 280
    np.testing.assert_array_equal(pixel[~inside], 12 * 16)
    np.testing.assert_array_equal(pixel[inside], (row * 16 + column)[inside])
    np.testing.assert_allclose(depth[inside], z[inside], rtol=1e-5)
