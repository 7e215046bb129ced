"""Depth rendering (Eq. 1): values against loops, gradients to the winners alone."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.test_util import check_grads

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.render import render_depth
from tests.geometry.test_camera import looped_projection

RNG = np.random.default_rng(0)
CAMERA = Camera.look_at((2.5, 1.0, 0.8), (0.0, 0.0, 0.0), height=16, width=20)
render = jax.jit(render_depth)
depth_sum_gradient = jax.jit(
    jax.grad(lambda points, camera: render_depth(points, camera)[0].sum(), (0, 1))
)


def cloud(count: int = 400) -> np.ndarray:
    return RNG.uniform(-1.2, 1.2, (count, 3)).astype(np.float32)


def looped_render(points, camera):
    """Depth (0 where empty) and the winner's index (-1 where empty), by a loop."""
    depth = np.full((camera.height, camera.width), np.inf)
    winner = np.full(depth.shape, -1)
    uv, z = looped_projection(points, camera)
    for i, (column, row) in enumerate(np.floor(uv + 0.5).astype(int)):
        inside = 0 <= row < camera.height and 0 <= column < camera.width
        if inside and 0 < z[i] < depth[row, column]:
            depth[row, column], winner[row, column] = z[i], i
    return np.where(winner >= 0, depth, 0), winner


def test_agrees_with_a_loop():
    points = cloud()
    depth, mask = render(points, CAMERA)
    expected, winner = looped_render(points, CAMERA)
    assert 50 < mask.sum() < mask.size
    assert np.array_equal(mask, winner >= 0)
    assert np.allclose(depth, expected, atol=1e-5)
    assert np.all(np.asarray(depth)[~np.asarray(mask)] == 0)


def test_gradient_reaches_the_winners_depth_alone():
    points = cloud()
    gradient, _ = depth_sum_gradient(points, CAMERA)
    _, winner = looped_render(points, CAMERA)
    expected = np.zeros_like(points)
    # A winner's gradient is along the viewing axis, d z / d p.
    expected[winner[winner >= 0]] = np.asarray(CAMERA.rotation)[2]
    assert len(points) - (winner >= 0).sum() > 50
    assert np.allclose(gradient, expected, atol=1e-5)
    again, _ = depth_sum_gradient(points, CAMERA)
    assert np.array_equal(gradient, again)


def test_gradients(x64):
    camera = Camera.look_at((2.5, 1.0, 0.8), (0.0, 0.0, 0.0), height=8, width=8)
    points = jnp.asarray(cloud(60), jnp.float64)
    # Away from the pixel borders, where the depth image jumps.
    uv = camera.project(points)[0] + 0.5
    points = points[(jnp.abs(uv - jnp.round(uv)) > 0.02).all(axis=1)]

    def squared_depth(points, rotation, translation):
        posed = Camera(rotation, translation, camera.intrinsics, 8, 8)
        return render_depth(points, posed)[0] ** 2

    pose = (camera.rotation, camera.translation)
    check_grads(jax.jit(squared_depth), (points, *pose), 2, ("rev",), eps=1e-4)


POSITION = np.asarray(CAMERA.position)
BAD = {
    "behind": POSITION * np.linspace(1.1, 9, 5)[:, None],
    "outside": POSITION + 50 * np.asarray(CAMERA.rotation)[:1],
    "at the camera": POSITION[None],
    "in its plane": POSITION + np.asarray(CAMERA.rotation)[:2],
    "huge": np.array([[1e30, -1e30, 1e30], [-1e38, 3e38, 1e20]]),
    "not finite": np.array([[np.nan, 0, 0], [np.inf, 0, 0], [-np.inf, np.inf, 0]]),
}


def test_an_empty_view_is_empty_and_has_no_gradient():
    for points in [*(np.resize(rows, (400, 3)) for rows in BAD.values()), cloud(0)]:
        points = jnp.asarray(points, jnp.float32)
        depth, mask = render(points, CAMERA)
        assert not mask.any() and np.all(depth == 0)
        for leaf in jax.tree.leaves(depth_sum_gradient(points, CAMERA)):
            assert np.all(leaf == 0)


def test_bad_points_do_not_hide_good_ones():
    bad = np.concatenate([*BAD.values()]).astype(np.float32)
    good = cloud(400 - len(bad))
    mixed = np.concatenate([bad, good])
    # Copies of a good point behind it.
    farther = good[:1] + 0.2 * (good[:1] - POSITION).astype(np.float32)
    alone = np.concatenate([np.tile(farther, (len(bad), 1)), good])
    for expected, found in zip(
        render(alone, CAMERA), render(mixed, CAMERA), strict=True
    ):
        assert np.array_equal(expected, found)
    gradient, of_pose = depth_sum_gradient(mixed, CAMERA)
    assert np.all(np.isfinite(gradient)) and np.abs(gradient).sum() > 1
    _, expected = depth_sum_gradient(alone, CAMERA)
    for found, leaf in zip(*map(jax.tree.leaves, (of_pose, expected)), strict=True):
        np.testing.assert_allclose(found, leaf, rtol=1e-5)


def test_equal_nearest_points_share_the_gradient():
    points = np.tile(-0.1 * POSITION, (400, 1)).astype(np.float32)
    points[:2] = 0.0
    gradient, _ = depth_sum_gradient(points, CAMERA)
    share = 0.5 * np.asarray(CAMERA.rotation)[2]
    assert np.allclose(gradient[:3], [share, share, 0 * share], atol=1e-6)


def test_pixel_borders():
    """Pixel centres at integers: the image covers -0.5 up to, not at, width - 0.5."""
    camera = Camera(jnp.eye(3), jnp.zeros(3), jnp.eye(3), height=1, width=4)
    u = np.array([-0.51, -0.5, 0.49, 0.5, 3.49, 3.5])
    falls_on = [None, 0, 0, 1, 3, None]
    for coordinate, pixel in zip(u, falls_on, strict=True):
        point = jnp.array([[coordinate, 0.0, 1.0]])
        expected = np.arange(4) == (-1 if pixel is None else pixel)
        assert np.array_equal(render(point, camera)[1][0], expected)


def test_vmap_over_clouds_and_cameras():
    clouds = np.stack([cloud(), cloud()])
    cameras = [CAMERA, Camera.look_at((0, 2.0, 1.0), (0, 0, 0), height=16, width=20)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    depth, mask = jax.jit(jax.vmap(render_depth))(clouds, stacked)
    for i in range(2):
        expected_depth, expected_mask = render(clouds[i], cameras[i])
        assert np.allclose(depth[i], expected_depth, atol=1e-6)
        assert np.array_equal(mask[i], expected_mask)
