"""Eq. 6: the perturbation's statistics, the upsampled target, the loss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial import KDTree

from prism_jax.losses.denoise import denoise_loss, perturb, upsample_midpoints

RNG = np.random.default_rng(6)
KEY = jax.random.key(0)
ORIGIN = jnp.asarray([0.5, -2.0, 1.0])

disturb = jax.jit(perturb, static_argnames=("jitter", "drop", "range_noise"))
upsample = jax.jit(upsample_midpoints)


def cloud(*shape: int) -> jax.Array:
    return jnp.asarray(RNG.normal(size=(*shape, 3)), jnp.float32)


def test_jitter_has_its_standard_deviation_in_every_direction():
    points = cloud(4096)
    noise = disturb(KEY, points, ORIGIN, drop=0.0, range_noise=0.0) - points
    assert np.allclose(np.cov(noise.T), 1e-4 * np.eye(3), atol=6e-6)
    assert np.allclose(np.mean(noise, axis=0), 0, atol=6e-4)


def test_range_noise_moves_points_along_their_rays_in_proportion_to_range():
    """And grows no more beyond the farthest place, in any direction of the sensor."""
    points, direction = cloud(4096), ORIGIN / jnp.linalg.norm(ORIGIN)

    def moves(origin):
        return np.asarray(disturb(KEY, points, origin, jitter=0.0, drop=0.0) - points)

    moved, rays = moves(ORIGIN), np.asarray(points - ORIGIN)
    assert np.allclose(np.cross(rays, moved), 0, atol=1e-5)
    share = np.sum(moved * rays, axis=1) / np.sum(rays**2, axis=1)
    assert np.isclose(share.std(), 0.005, rtol=0.04)
    assert abs(share.mean()) < 0.0003
    spread = [np.linalg.norm(moves(d * direction), axis=1).std() for d in (8.0, 16.0)]
    assert np.isclose(spread[1], 2 * spread[0], rtol=0.1)
    far, farther = (moves(distance * direction) for distance in (16.0, 1e15))
    assert np.allclose(far, farther, atol=1e-5)


def test_gradients_are_finite_wherever_the_sensor_is():
    """And reach the points that are kept."""
    total = jax.grad(lambda *at: jnp.sum(perturb(KEY, *at, drop=0.5)), (0, 1))
    slopes = jax.jit(total)
    for origin in (0 * ORIGIN, ORIGIN, 1e4 * ORIGIN):
        points = cloud(20).at[0].set(origin)
        to_points, to_origin = slopes(points, origin)
        assert np.sum(np.any(np.asarray(to_points) != 0, axis=1)) == 10
        assert np.allclose(to_points.sum(axis=0), 20, rtol=0.02)
        assert np.isfinite(to_origin).all()


@pytest.mark.parametrize(("drop", "num_kept"), [(0.3, 35), (1.0, 1)])
def test_dropped_points_become_copies_of_kept_ones(drop, num_kept):
    points = cloud(50)
    result = disturb(KEY, points, ORIGIN, jitter=0.0, range_noise=0.0, drop=drop)
    kept = np.all(np.asarray(result == points), axis=1)
    assert kept.sum() == num_kept
    survivors = {tuple(row) for row in np.asarray(points)[kept]}
    assert {tuple(row) for row in np.asarray(result)} == survivors


def test_perturbation_is_decided_by_the_key():
    keys = jax.random.split(KEY, 3)
    points = cloud(50)
    batched = jax.vmap(lambda key: disturb(key, points, ORIGIN))(keys)
    for key, many in zip(keys, batched, strict=True):
        alone = disturb(key, points, ORIGIN)
        assert np.allclose(many, alone, atol=1e-6)
        # Copies are made after the noise.
        assert len(np.unique(alone, axis=0)) == 45
    assert not np.allclose(batched[0], batched[1], atol=1e-3)


def test_degenerate_clouds_stay_finite():
    for points in (jnp.ones((1, 3)), jnp.tile(ORIGIN, (50, 1))):
        assert np.all(np.isfinite(disturb(KEY, points, ORIGIN)))
    with pytest.raises(ValueError, match="fraction"):
        perturb(KEY, cloud(5), ORIGIN, drop=1.5)


def tree_midpoints(points):
    """Midpoints to the nearest point that is not a copy; itself if there is none."""
    midpoints = []
    for point in points:
        apart = points[np.any(points != point, axis=1)]
        neighbor = apart[KDTree(apart).query(point)[1]] if len(apart) else point
        midpoints.append((point + neighbor) / 2)
    return np.asarray(midpoints)


@pytest.mark.parametrize(
    "points",
    [
        np.tile(cloud(40), (3, 1)),
        np.full((9, 3), 2.0),
        np.ones((1, 3)),
        np.outer(np.arange(9) ** 2, (1.0, 0, 0)) + 4096,
    ],
    ids=["three of each", "repeated", "single", "collinear, far away"],
)
def test_midpoints_agree_with_a_tree(points):
    points = points.astype(np.float32)
    result = np.asarray(upsample(points))
    assert np.array_equal(result[: len(points)], points)
    assert np.allclose(result[len(points) :], tree_midpoints(points), atol=1e-6)


def test_midpoints_pass_half_of_the_gradient_to_each_end():
    points = jnp.asarray([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    slope = jax.jit(jax.grad(lambda p: jnp.sum(upsample_midpoints(p)[3:, 0])))
    # Pairs: 0-1, 1-0 and 2-1.
    assert np.allclose(slope(points)[:, 0], [1.0, 1.5, 0.5])


loss = jax.jit(lambda *clouds: denoise_loss(*clouds, 0.3))


def test_loss_is_chamfer_plus_offsets():
    denoised, target, offsets = cloud(30), cloud(60), cloud(30)
    forward, _ = KDTree(target).query(denoised)
    backward, _ = KDTree(denoised).query(target)
    penalty = np.mean(np.linalg.norm(offsets, axis=1) ** 2)
    expected = np.mean(forward**2) + np.mean(backward**2) + 0.3 * penalty
    assert np.allclose(loss(denoised, target, offsets), expected, rtol=1e-5)


def test_loss_gradients(x64):
    # Targets next to their points and far from the others: no flip of a neighbour.
    denoised = jnp.asarray(np.argwhere(np.ones((2, 2, 2))), float)
    target = jnp.concatenate([denoised + 0.1, denoised - 0.15])
    inputs = denoised, target, jnp.asarray(RNG.normal(size=(8, 3)))
    check_grads(loss, inputs, order=1, modes=["rev"], eps=1e-5, rtol=1e-6)
    same = denoised, jnp.concatenate([denoised, denoised]), jnp.zeros((8, 3))
    for gradient in jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*same):
        assert np.all(np.asarray(gradient) == 0)
