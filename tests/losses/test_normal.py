"""Eq. 5: values against a loop, gradients to the predicted normals alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial import KDTree

from prism_jax.geometry.neighbors import knn
from prism_jax.losses.normal import normal_loss

RNG = np.random.default_rng(5)

loss = jax.jit(normal_loss, static_argnames=("lambda_smooth", "k", "stride"))
gradients = jax.jit(jax.grad(normal_loss, argnums=(0, 1)), static_argnames="k")


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def directions(*shape: int) -> np.ndarray:
    return unit(RNG.normal(size=(*shape, 3))).astype(np.float32)


def surface(*shape: int) -> np.ndarray:
    """Points of an ellipsoid: curved, so that PCA has one least direction."""
    return directions(*shape) * np.asarray([1.0, 0.8, 0.6], np.float32)


def looped_loss(normals, points, lambda_smooth, k):
    _, neighbors = KDTree(points).query(points, k=k)
    agreement, differences = [], []
    for j, row in enumerate(np.asarray(neighbors)):
        _, vectors = np.linalg.eigh(np.cov(points[row].T))
        agreement.append(1 - abs(normals[j] @ vectors[:, 0]))
        differences += [np.abs(normals[j] - normals[i]).sum() for i in row if i != j]
    return np.mean(agreement) + lambda_smooth * np.mean(differences)


@pytest.mark.parametrize(("lambda_smooth", "k"), [(0.0, 12), (0.1, 12), (2.0, 6)])
def test_agrees_with_a_loop(lambda_smooth, k):
    points, normals = surface(120), directions(120)
    expected = looped_loss(normals, points.astype(np.float64), lambda_smooth, k)
    value = loss(normals, points, lambda_smooth, k=k)
    assert np.allclose(value, expected, rtol=1e-4)


@pytest.mark.parametrize(("count", "stride"), [(120, 5), (121, 4), (120, 200)])
def test_over_every_so_many_th_point(count, stride):
    points, normals = jnp.asarray(surface(count)), jnp.asarray(directions(count))
    _, neighbors = KDTree(points).query(points[::stride], k=12)
    found = loss(normals, points, 0.3, k=12, stride=stride)
    agreement, differences = [], []
    for j, row in zip(range(0, count, stride), np.asarray(neighbors), strict=True):
        _, vectors = np.linalg.eigh(np.cov(np.asarray(points, float)[row].T))
        agreement.append(1 - abs(normals[j] @ vectors[:, 0]))
        differences += [np.abs(normals[j] - normals[i]).sum() for i in row if i != j]
    expected = np.mean(agreement) + 0.3 * np.mean(differences)
    assert np.allclose(found, expected, rtol=1e-4)


def test_normals_of_a_plane_have_no_loss_whatever_their_sign():
    points = RNG.uniform(-1, 1, (60, 3)).astype(np.float32)
    points[:, 2] = 0.3
    up = np.tile(np.asarray([0, 0, 1], np.float32), (60, 1))
    assert np.allclose(loss(up, points), 0, atol=1e-5)
    assert np.allclose(loss(-up, points), 0, atol=1e-5)
    sideways = np.roll(up, 1, axis=1)
    assert np.allclose(loss(sideways, points), 1, atol=1e-5)


def test_gradient_reaches_the_normals_and_not_the_points(x64):
    points, normals = (
        jnp.asarray(surface(30), float),
        jnp.asarray(directions(30), float),
    )
    # Away from the kinks of the absolute values.
    graph = np.asarray(knn(points, points, 6))
    differences = np.abs(normals[:, None] - normals[graph])[:, 1:]
    assert differences.min() > 1e-5
    evaluate = jax.jit(lambda n: normal_loss(n, points, k=6))
    check_grads(evaluate, (normals,), order=1, modes=["rev"], eps=1e-6, rtol=1e-5)
    to_normals, to_points = gradients(normals, points, k=6)
    assert np.all(np.linalg.norm(to_normals, axis=1) > 0)
    assert np.all(np.asarray(to_points) == 0)


@pytest.mark.parametrize(
    "points",
    [
        np.full((20, 3), 0.5),
        np.outer(np.linspace(-1, 1, 20), (1.0, 2.0, 3.0)),
        np.ones((1, 3)),
        np.asarray([[0.0, 0, 0], [1, 0, 0]]),
        np.repeat(np.eye(3), 7, axis=0) + 1e4,
    ],
    ids=["repeated", "collinear", "single", "pair", "duplicates_far_away"],
)
def test_degenerate_clouds(points):
    points = points.astype(np.float32)
    for normals in (directions(len(points)), np.zeros_like(points)):
        value = loss(normals, points)
        assert 0 <= value < 3
        assert all(np.all(np.isfinite(g)) for g in gradients(normals, points))


def test_a_single_point_has_no_smoothness():
    point, normal = np.ones((1, 3), np.float32), directions(1)
    assert loss(normal, point, 100.0) == loss(normal, point, 0.0)


def test_repeated_points_count_as_edges_to_their_copies():
    # Two copies of one point: an edge each way, no edge to itself.
    points = np.zeros((2, 3), np.float32)
    normals = np.eye(3, dtype=np.float32)[:2]
    smooth = loss(normals, points, 1.0) - loss(normals, points, 0.0)
    assert np.allclose(smooth, 2.0)
