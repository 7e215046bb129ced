"""PCA normals against closed forms and LAPACK's eigenvectors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.geometry.normals import pca_normals

RNG = np.random.default_rng(0)
normals_of = jax.jit(pca_normals, static_argnames="k")


def sphere(count: int = 200) -> np.ndarray:
    """Fibonacci points on the unit sphere: evenly spread, so every patch is alike."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z**2)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return points.astype(np.float32)


def plane(normal, count: int = 200) -> np.ndarray:
    normal = np.asarray(normal) / np.linalg.norm(normal)
    points = RNG.normal(size=(count, 3))
    return points - (points @ normal)[:, None] * normal


def agreement(normals, expected):
    """|cosine| between normals, whose sign is arbitrary."""
    return np.abs((np.float64(normals) * np.float64(expected)).sum(-1))


def test_a_plane_has_one_normal():
    for normal in [(0, 0, 1), (1, 0, 0), (1, 2, 3), (1, -1, 1e-3)]:
        expected = np.asarray(normal) / np.linalg.norm(normal)
        for scale in (1e-6, 1.0, 1e6):
            found = normals_of(jnp.asarray(scale * plane(normal), jnp.float32))
            assert agreement(found, expected).min() > 1 - 1e-6
    # Multiples of 1/128 stay exact next to 10,000; the plane is z = x.
    points = np.round(128 * RNG.normal(size=(200, 3))) / 128
    points[:, 2] = points[:, 0]
    far = jnp.asarray(points + [8192.0, -16384.0, 8192.0], jnp.float32)
    expected = np.array([1, 0, -1]) / np.sqrt(2)
    assert agreement(normals_of(far), expected).min() > 1 - 1e-6


def test_agrees_with_lapack():
    points = sphere() + 0.02 * RNG.normal(size=(200, 3)).astype(np.float32)
    near = points[KDTree(points).query(points, 16)[1]].astype(np.float64)
    near -= near.mean(axis=1, keepdims=True)
    expected = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][..., 0]
    found = normals_of(points, k=16)
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    assert agreement(found, expected).min() > 1 - 1e-5
    # Radial, but for the noise.
    assert (
        agreement(found, points / np.linalg.norm(points, axis=1)[:, None]).min() > 0.9
    )


def test_given_neighbors_replace_the_search():
    """Neighbours from a plane z = 0 give its normal, whatever a search would find."""
    flat = jnp.concatenate([sphere(), jnp.asarray(plane((0, 0, 1), 20), jnp.float32)])
    indices = jnp.broadcast_to(jnp.arange(200, 220), (220, 20))
    found = normals_of(flat, neighbors=indices)
    assert agreement(found, [0, 0, 1]).min() > 1 - 1e-5


LINE = np.linspace(0, 1, 20)[:, None] * [[1.0, 2.0, -1.0]]
DEGENERATE = {
    "one point": np.ones((1, 3)),
    "two points": np.array([[0.0, 0, 0], [1, 1, 1]]),
    "coincident": np.full((20, 3), 0.7),
    "collinear": LINE,
    "on an axis": LINE * [1, 0, 0],
    "pairs of copies": np.repeat(sphere(10), 2, axis=0),
    "isotropic": np.resize([*np.eye(3), *-np.eye(3)], (20, 3)),
    "tiny": 1e-12 * sphere(20),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_neighborhoods_give_unit_vectors_without_a_gradient(name):
    points = jnp.asarray(DEGENERATE[name], jnp.float32)
    found = np.asarray(normals_of(points))
    assert found.shape == points.shape
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    if name in ("one point", "coincident"):
        assert np.array_equal(found, np.broadcast_to([1.0, 0, 0], found.shape))
    if name in ("two points", "collinear", "on an axis"):
        direction = DEGENERATE[name][-1] / np.linalg.norm(DEGENERATE[name][-1])
        assert agreement(found, direction).max() < 1e-5
    if name in ("isotropic", "coincident"):
        gradient = jax.grad(lambda p: (normals_of(p) * jnp.arange(3.0)).sum())(points)
        assert np.all(gradient == 0)


def test_vmap():
    clouds = np.stack([sphere(), plane((1, 2, 3)).astype(np.float32)])
    found = jax.jit(jax.vmap(pca_normals))(clouds)
    for i in range(2):
        assert agreement(found[i], normals_of(clouds[i])).min() > 1 - 1e-5
