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
value_and_grad = jax.jit(jax.value_and_grad(normal_loss, argnums=(0, 1)))


def directions(*shape: int) -> np.ndarray:
    vectors = RNG.normal(size=(*shape, 3))
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors.astype(np.float32)


def surface(*shape: int) -> np.ndarray:
    """Points of an ellipsoid: curved, so that PCA has one least direction."""
    return directions(*shape) * np.asarray([1.0, 0.8, 0.6], np.float32)


@pytest.mark.parametrize(("count", "stride"), [(120, 1), (120, 5), (120, 200)])
def test_over_every_so_many_th_point(count, stride):
    points, normals = surface(count), directions(count)
    _, neighbors = KDTree(points).query(points[::stride], k=12)
    agreement, differences = [], []
    for j, row in zip(range(0, count, stride), neighbors, strict=True):
        _, vectors = np.linalg.eigh(np.cov(np.asarray(points, float)[row].T))
        agreement.append(1 - abs(normals[j] @ vectors[:, 0]))
        differences += [np.abs(normals[j] - normals[i]).sum() for i in row if i != j]
    expected = np.mean(agreement) + 0.3 * np.mean(differences)
    found = loss(normals, points, 0.3, k=12, stride=stride)
    assert np.allclose(found, expected, rtol=1e-4)


def test_normals_of_a_plane_have_no_loss_whatever_their_sign():
    points = RNG.uniform(-1, 1, (60, 3)).astype(np.float32)
    points[:, 2] = 0.3
    up = np.tile(np.asarray([0, 0, 1], np.float32), (60, 1))
    for normals, expected in ((up, 0), (-up, 0), (np.roll(up, 1, axis=1), 1)):
        assert np.allclose(loss(normals, points), expected, atol=1e-5)


def test_gradient_reaches_the_normals_and_not_the_points(x64):
    points, normals = (jnp.asarray(make(30), float) for make in (surface, directions))
    graph = knn(points, points, 6)
    # Away from the kinks of the absolute values.
    assert np.abs(normals[:, None] - normals[graph])[:, 1:].min() > 1e-5
    evaluate = jax.jit(lambda n: normal_loss(n, points, k=6))
    check_grads(evaluate, (normals,), order=1, modes=["rev"], eps=1e-6, rtol=1e-5)
    _, (to_normals, to_points) = value_and_grad(normals, points)
    assert np.all(np.linalg.norm(to_normals, axis=1) > 0)
    assert np.all(np.asarray(to_points) == 0)


@pytest.mark.parametrize(
    "points",
    [
        np.full((20, 3), 0.5),
        np.outer(np.linspace(-1, 1, 20), (1.0, 2.0, 3.0)),
        np.repeat(np.eye(3), 7, axis=0)[:20] + 1e4,
    ],
    ids=["repeated", "collinear", "duplicates_far_away"],
)
def test_degenerate_clouds(points):
    points = points.astype(np.float32)
    for normals in (directions(len(points)), np.zeros_like(points)):
        value, gradients = value_and_grad(normals, points)
        assert 0 <= value < 3
        assert all(np.all(np.isfinite(g)) for g in gradients)


def test_an_edge_joins_two_points():
    """To a copy, each way; of a single point there is none."""
    for count, expected in ((1, 0.0), (2, 2.0)):
        points, normals = np.zeros((count, 3), np.float32), jnp.eye(count, 3)
        smooth = loss(normals, points, 1.0) - loss(normals, points, 0.0)
        assert np.allclose(smooth, expected)
