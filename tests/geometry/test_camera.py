"""Camera: against SciPy rotations, Open3D's pinhole and closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from prism_jax.geometry.camera import MIN_DEPTH, VIEWS, Camera

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
    for point in np.asarray(points, np.float64):
        x, y, z = np.asarray(camera.rotation, np.float64) @ point + np.asarray(
            camera.translation, np.float64
        )
        k = np.asarray(camera.intrinsics, np.float64)
        uv.append(
            [
                k[0, 0] * x / z + k[0, 1] * y / z + k[0, 2],
                k[1, 1] * y / z + k[1, 2],
            ]
        )
        depth.append(z)
    return np.array(uv), np.array(depth)


def test_project_agrees_with_a_loop():
    camera = posed_camera()
    points = RNG.uniform(-1, 1, (40, 3)).astype(np.float32)
    uv, z = camera.project(points)
    expected_uv, expected_z = looped_projection(points, camera)
    assert np.allclose(uv, expected_uv, atol=1e-4)
    assert np.allclose(z, expected_z, atol=1e-5)


def test_project_gradients(x64):
    camera = posed_camera()
    points = jnp.asarray(RNG.uniform(-1, 1, (5, 3)))
    project = jax.jit(lambda points, camera: camera.project(points))
    check_grads(project, (points, camera), order=1)


def test_points_without_an_image_stay_finite():
    camera = Camera.look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    points = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, -2.0, 0.1]])
    uv, z = camera.project(points)
    assert np.all(np.isfinite(uv)) and np.all(z <= MIN_DEPTH)
    gradient = jax.jit(jax.grad(lambda p: camera.project(p)[0].sum()))(points)
    assert np.all(np.isfinite(gradient))


def test_no_points_project_to_nothing():
    uv, z = posed_camera().project(jnp.zeros((0, 3)))
    assert uv.shape == (0, 2) and z.shape == (0,)


def test_position_is_the_point_at_the_camera_origin():
    camera = posed_camera()
    assert np.allclose(camera.to_camera(camera.position[None]), 0, atol=1e-5)
    cameras = jax.tree.map(lambda *x: jnp.stack(x), *[posed_camera(i) for i in (1, 2)])
    assert np.allclose(cameras.position[1], posed_camera(2).position, atol=1e-5)


def test_unproject_inverts_project():
    camera = posed_camera()
    shape = (camera.height, camera.width)
    depth = jnp.asarray(RNG.uniform(1, 4, shape).astype(np.float32))
    mask = jnp.asarray(RNG.random(shape) < 0.6)
    points = camera.unproject(depth, mask)
    kept = np.asarray(mask).reshape(-1)
    uv, z = camera.project(points[kept])
    rows, columns = np.nonzero(np.asarray(mask))
    assert np.allclose(uv, np.stack([columns, rows], 1), atol=1e-4)
    assert np.allclose(z, np.asarray(depth)[np.asarray(mask)], atol=1e-5)
    assert np.allclose(points[~kept], camera.position, atol=1e-5)


def test_unproject_agrees_with_open3d():
    o3d = pytest.importorskip("open3d")
    camera = dataclasses.replace(
        posed_camera(),
        intrinsics=jnp.array([[11.0, 0, 7.2], [0, 13.0, 5.9], [0, 0, 1]]),
    )
    depth = RNG.uniform(1, 4, (camera.height, camera.width)).astype(np.float32)
    extrinsic = np.eye(4)
    extrinsic[:3, :3], extrinsic[:3, 3] = camera.rotation, camera.translation
    expected = o3d.geometry.PointCloud.create_from_depth_image(
        o3d.geometry.Image(depth),
        o3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, 11.0, 13.0, 7.2, 5.9
        ),
        extrinsic,
        depth_scale=1.0,
        depth_trunc=100.0,
    )
    points = camera.unproject(jnp.asarray(depth), jnp.ones(depth.shape, bool))
    assert np.allclose(points, np.asarray(expected.points), atol=1e-5)


def test_unproject_gradients(x64):
    camera = posed_camera(height=3, width=4)
    depth = jnp.asarray(RNG.uniform(1, 4, (3, 4)))
    mask = jnp.asarray(RNG.random((3, 4)) < 0.6)
    check_grads(jax.jit(lambda depth: camera.unproject(depth, mask)), (depth,), order=1)
    gradient = jax.grad(lambda depth: (camera.unproject(depth, mask) ** 2).sum())
    assert np.all(np.asarray(gradient(depth))[~np.asarray(mask)] == 0)


@pytest.mark.parametrize(
    ("eye", "target"),
    [
        ((3.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.3, -2.0, 1.0), (0.1, 0.2, -0.3)),
        ((0.0, 0.0, 2.0), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, -2.0), (0.0, 0.0, 0.0)),
        ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
    ],
)
def test_look_at(eye, target):
    camera = Camera.look_at(eye, target, height=48, width=64)
    rotation = np.asarray(camera.rotation, np.float64)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-5)
    assert np.allclose(camera.position, eye, atol=1e-5)
    if eye != target:
        uv, z = camera.project(jnp.array([target]))
        assert np.allclose(uv, [[31.5, 23.5]], atol=1e-3)
        assert z[0] == pytest.approx(np.linalg.norm(np.subtract(eye, target)), rel=1e-5)


def test_look_at_keeps_up_up_and_right_right():
    camera = Camera.look_at((-3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    # Looking along +x with z up, -y is to the right.
    uv, _ = camera.project(jnp.array([[0.0, 0, 0], [0.0, 0, 1], [0.0, -1, 0]]))
    assert uv[1, 1] < uv[0, 1] and uv[2, 0] > uv[0, 0]


def test_field_of_view_reaches_the_image_border():
    camera = Camera.look_at((0.0, -2.0, 0.0), (0.0, 0, 0), fov_degrees=90, height=100)
    uv, _ = camera.project(jnp.array([[0.0, 0.0, -2.0], [0.0, 0.0, 2.0]]))
    assert np.allclose(uv[:, 1], [99.5, -0.5], atol=1e-3)


def test_look_at_gradients(x64):
    @jax.jit
    def pose(eye, target, fov):
        camera = Camera.look_at(eye, target, fov_degrees=fov)
        return camera.rotation, camera.translation, camera.intrinsics

    eye, target = jnp.array([2.0, 1.0, 0.5]), jnp.array([0.1, 0.2, 0.3])
    check_grads(pose, (eye, target, jnp.array(50.0)), order=1)


def test_resized_keeps_the_field_of_view():
    camera = posed_camera(height=12, width=16)
    resized = camera.resized(36, 24)
    points = RNG.uniform(-1, 1, (20, 3)).astype(np.float32)
    expected = (np.asarray(camera.project(points)[0]) + 0.5) * [24 / 16, 36 / 12] - 0.5
    assert np.allclose(resized.project(points)[0], expected, atol=1e-4)
    assert (resized.height, resized.width) == (36, 24)


@pytest.mark.parametrize("view", VIEWS)
def test_fixed_views_hold_the_workspace(view):
    camera = Camera.fixed_view(view)
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(8, 3)
    uv, z = camera.project(corners.astype(np.float32))
    assert np.all(uv > -0.51) and np.all(uv < 127.51) and np.all(z > 0.5)
    position = np.asarray(camera.position)
    assert position @ VIEWS[view] > 0.999 * np.linalg.norm(position)
    by_index = Camera.fixed_view(list(VIEWS).index(view))
    assert np.array_equal(by_index.rotation, camera.rotation)


@pytest.mark.parametrize("view", ["sideways", -1, 99])
def test_an_unknown_fixed_view_lists_the_known(view):
    with pytest.raises(ValueError, match="front_left_top"):
        Camera.fixed_view(view)


def test_l515_has_its_data_sheet_field_of_view():
    camera = Camera.l515()
    assert (camera.height, camera.width) == (480, 640)
    border = camera.unproject(jnp.ones((480, 640)), jnp.ones((480, 640), bool))
    border = np.asarray(border).reshape(480, 640, 3)
    # Between the outermost pixel centres, one pixel short of the whole angle.
    assert np.degrees(2 * np.arctan(border[0, -1, 0])) == pytest.approx(70, abs=0.2)
    assert np.degrees(2 * np.arctan(border[-1, 0, 1])) == pytest.approx(55, abs=0.2)
    moved = Camera.l515(translation=(0.0, 0.0, 2.0))
    assert np.allclose(moved.position, [0, 0, -2])


def test_jit_and_vmap_over_cameras():
    cameras = [posed_camera(seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *cameras)
    points = jnp.asarray(RNG.uniform(-1, 1, (4, 3)), jnp.float32)
    project = jax.jit(jax.vmap(Camera.project, in_axes=(0, None)))
    uv, z = project(stacked, points)
    for i, camera in enumerate(cameras):
        assert np.allclose(uv[i], camera.project(points)[0], atol=1e-5)
        assert np.allclose(z[i], camera.project(points)[1], atol=1e-5)
    eyes = jnp.array([[2.0, 0, 0], [0, 0, 2.0]])
    made = jax.jit(jax.vmap(lambda eye: Camera.look_at(eye, jnp.zeros(3))))(eyes)
    assert np.allclose(made.position, eyes, atol=1e-6)


def test_framing_fills_the_view_with_the_points():
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform(-0.3, 0.3, (200, 3)) + [0.5, 0, 0], jnp.float32)
    eye = jnp.array([3.0, -1.0, 0.5])
    camera = Camera.framing(points, eye, margin=1.25)
    uv, depth = camera.project(points)
    np.testing.assert_allclose(camera.position, eye, atol=1e-5)
    assert (depth > 0).all()
    # The outermost point lies at 1 / margin of the half width from the centre.
    offset = np.abs(np.asarray(uv) - 63.5).max()
    np.testing.assert_allclose(offset, 64 / 1.25, rtol=1e-4)


def test_framing_from_inside_the_cloud_is_capped():
    points = jnp.asarray(np.random.default_rng(0).normal(size=(50, 3)), jnp.float32)
    camera = jax.jit(Camera.framing)(points, points.mean(0))
    half_angle = np.arctan(64.0 / np.asarray(camera.intrinsics)[0, 0])
    np.testing.assert_allclose(np.rad2deg(half_angle), 60.0, rtol=1e-4)
    one = Camera.framing(jnp.ones((1, 3)), jnp.zeros(3))
    assert np.isfinite(np.asarray(one.intrinsics)).all()


@pytest.mark.parametrize("xp", [np, jnp])
def test_pixels_are_counted_row_by_row_and_one_past_the_last_is_none(xp):
    camera = posed_camera()
    points = RNG.uniform(-3, 3, (300, 3)).astype(np.float32)
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
