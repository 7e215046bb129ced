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

disturb = jax.jit(
    perturb, static_argnames=("jitter", "drop", "range_noise", "max_distance")
)
upsample = jax.jit(upsample_midpoints, static_argnames="num_candidates")
gradients = jax.jit(jax.grad(denoise_loss, argnums=(0, 1, 2)))


def cloud(*shape: int) -> jax.Array:
    return jnp.asarray(RNG.normal(size=(*shape, 3)), jnp.float32)


def test_jitter_has_its_standard_deviation_in_every_direction():
    points = cloud(4096)
    noise = disturb(KEY, points, ORIGIN, drop=0.0, range_noise=0.0) - points
    covariance = np.cov(np.asarray(noise).T)
    assert np.allclose(covariance, 1e-4 * np.eye(3), atol=6e-6)
    assert np.allclose(np.mean(noise, axis=0), 0, atol=6e-4)


def test_range_noise_moves_points_along_their_rays_in_proportion_to_range():
    points = cloud(4096)
    moved = disturb(KEY, points, ORIGIN, jitter=0.0, drop=0.0, range_noise=0.02)
    rays, moves = np.asarray(points - ORIGIN), np.asarray(moved - points)
    assert np.allclose(np.cross(rays, moves), 0, atol=1e-5)
    share = np.sum(moves * rays, axis=1) / np.sum(rays**2, axis=1)
    assert np.isclose(share.std(), 0.02, rtol=0.04)
    assert abs(share.mean()) < 0.0012
    near = np.linalg.norm(rays, axis=1) < 2.0
    spread = np.linalg.norm(moves, axis=1)
    assert spread[near].mean() < 0.6 * spread[~near].mean()


def test_range_noise_grows_no_more_beyond_the_farthest_place():
    """However far off the sensor is, and in its direction."""
    points, direction = cloud(4096), ORIGIN / jnp.linalg.norm(ORIGIN)

    def moves(distance):
        moved = disturb(KEY, points, distance * direction, jitter=0.0, drop=0.0)
        return np.asarray(moved - points)

    def spread(distance):
        return np.linalg.norm(moves(distance), axis=1).std()

    assert np.isclose(spread(16.0), 2 * spread(8.0), rtol=0.1)
    for distance in (20.0, 1e3, 1e6, 1e15):
        assert np.allclose(moves(distance), moves(16.0), atol=1e-5)


def test_within_the_farthest_place_not_a_bit_depends_on_it():
    points = cloud(512)
    unbounded = disturb(KEY, points, 5 * ORIGIN, max_distance=1e9)
    assert np.array_equal(disturb(KEY, points, 5 * ORIGIN), unbounded)


@pytest.mark.parametrize("distance", [0.0, 1.0, 1e4])
def test_gradients_are_finite_wherever_the_sensor_is(distance):
    def total(points, origin):
        return jnp.sum(perturb(KEY, points, origin, drop=0.0))

    origin = distance * ORIGIN
    points = jnp.stack([origin, 3 * ORIGIN])
    for gradient in jax.jit(jax.grad(total, (0, 1)))(points, origin):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize(("drop", "num_kept"), [(0.0, 50), (0.3, 35), (1.0, 1)])
def test_dropped_points_become_copies_of_kept_ones(drop, num_kept):
    points = cloud(50)
    result = disturb(KEY, points, ORIGIN, jitter=0.0, range_noise=0.0, drop=drop)
    kept = np.all(np.asarray(result == points), axis=1)
    assert kept.sum() == num_kept
    survivors = {tuple(row) for row in np.asarray(points)[kept]}
    assert {tuple(row) for row in np.asarray(result)} == survivors


def test_copies_are_made_after_the_noise():
    result = np.asarray(disturb(KEY, cloud(50), ORIGIN, drop=0.4))
    assert len(np.unique(result, axis=0)) == 30


def test_perturbation_is_decided_by_the_key():
    points = cloud(30)
    again, other = KEY, jax.random.key(1)
    first = disturb(KEY, points, ORIGIN)
    assert np.array_equal(first, disturb(again, points, ORIGIN))
    assert not np.array_equal(first, disturb(other, points, ORIGIN))
    keys = jax.random.split(KEY, 3)
    batched = jax.vmap(lambda k: disturb(k, points, ORIGIN))(keys)
    for i in range(3):
        assert np.allclose(batched[i], disturb(keys[i], points, ORIGIN), atol=1e-6)


def test_perturbation_passes_gradients_on_to_kept_points():
    points = cloud(20)
    evaluate = jax.grad(lambda p: jnp.sum(perturb(KEY, p, ORIGIN, drop=0.5)))
    gradient = np.asarray(jax.jit(evaluate)(points))
    assert np.sum(np.any(gradient != 0, axis=1)) == 10
    assert np.allclose(gradient.sum(axis=0), 20, rtol=0.02)


def test_degenerate_clouds_stay_finite():
    for points in (jnp.ones((1, 3)), jnp.tile(ORIGIN, (5, 1))):
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


@pytest.mark.parametrize("copies", [1, 3])
def test_midpoints_agree_with_a_tree(copies):
    points = np.tile(cloud(40), (copies, 1))
    result = np.asarray(upsample(points))
    assert result.shape == (80 * copies, 3)
    assert np.array_equal(result[: len(points)], points)
    assert np.allclose(result[len(points) :], tree_midpoints(points), atol=1e-6)


@pytest.mark.parametrize(
    "points",
    [
        np.full((12, 3), 2.0),
        np.ones((1, 3)),
        np.asarray([[0.0, 0, 0], [1, 0, 0]]),
        np.outer(np.arange(9) ** 2, (1.0, 0, 0)),
        np.outer(np.arange(9) ** 2, (1.0, 0, 0)) + 4096,
    ],
    ids=["repeated", "single", "pair", "collinear", "far_away"],
)
def test_midpoints_of_degenerate_clouds(points):
    points = points.astype(np.float32)
    result = np.asarray(upsample(points))
    assert np.array_equal(result[len(points) :], tree_midpoints(points))


def test_more_copies_than_candidates_fall_back_to_the_point():
    points = np.repeat(np.eye(3, dtype=np.float32), 9, axis=0)
    result = np.asarray(upsample(points, num_candidates=4))
    assert np.array_equal(result, np.concatenate([points, points]))


def test_midpoints_pass_half_of_the_gradient_to_each_end():
    points = jnp.asarray([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    evaluate = jax.grad(lambda p: jnp.sum(upsample_midpoints(p)[3:, 0]))
    # Pairs: 0-1, 1-0 and 2-1.
    assert np.allclose(evaluate(points)[:, 0], [1.0, 1.5, 0.5])


def test_loss_is_chamfer_plus_offsets():
    denoised, target, offsets = cloud(30), cloud(60), cloud(30)
    forward, _ = KDTree(target).query(denoised)
    backward, _ = KDTree(denoised).query(target)
    distance = np.mean(forward**2) + np.mean(backward**2)
    penalty = np.mean(np.linalg.norm(offsets, axis=1) ** 2)
    loss = jax.jit(denoise_loss, static_argnums=3)
    value = loss(denoised, target, offsets, 0.3)
    assert np.allclose(value, distance + 0.3 * penalty, rtol=1e-5)


def test_loss_gradients(x64):
    # Targets next to their points and far from the others: no flip of a neighbour.
    denoised = jnp.asarray(np.argwhere(np.ones((2, 2, 2))), float)
    target = jnp.concatenate([denoised + 0.1, denoised - 0.15])
    offsets = jnp.asarray(RNG.normal(size=(8, 3)))
    evaluate = jax.jit(denoise_loss)
    check_grads(evaluate, (denoised, target, offsets), order=1, eps=1e-5, rtol=1e-6)


@pytest.mark.parametrize("count", [1, 10])
def test_loss_of_repeated_points_has_finite_gradients(count):
    points, offsets = jnp.ones((count, 3)), jnp.zeros((count, 3))
    target = upsample(points)
    for gradient in gradients(points, target, offsets):
        assert np.all(np.asarray(gradient) == 0)
