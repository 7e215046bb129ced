"""PCA normals against closed forms and Open3D."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.normals import pca_normals

RNG = np.random.default_rng(0)
normals_of = jax.jit(pca_normals, static_argnames="k")


def sphere(count: int = 1000) -> np.ndarray:
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


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (1, 2, 3), (1, -1, 1e-3)])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_plane_has_one_normal(normal, scale):
    points = scale * plane(normal)
    found = normals_of(jnp.asarray(points, jnp.float32))
    expected = np.asarray(normal) / np.linalg.norm(normal)
    assert agreement(found, expected).min() > 1 - 1e-6


def test_a_sphere_has_radial_normals():
    points = sphere()
    found = normals_of(points)
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    assert agreement(found, points).min() > np.cos(np.radians(2))


def test_agrees_with_open3d():
    o3d = pytest.importorskip("open3d")
    points = sphere(500) + 0.02 * RNG.normal(size=(500, 3)).astype(np.float32)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    found = normals_of(points, k=12)
    assert agreement(found, np.asarray(cloud.normals)).min() > 1 - 1e-5


def test_far_from_the_origin():
    # Multiples of 1/128 stay exact next to 10,000; the plane is z = x.
    points = np.round(128 * RNG.normal(size=(300, 3))) / 128
    points[:, 2] = points[:, 0]
    far = jnp.asarray(points + [8192.0, -16384.0, 8192.0], jnp.float32)
    expected = np.array([1, 0, -1]) / np.sqrt(2)
    assert agreement(normals_of(far), expected).min() > 1 - 1e-6


def test_given_neighbors_replace_the_search():
    points = jnp.asarray(sphere(200))
    neighbors = knn(points, points, 16)
    given = normals_of(points, neighbors=neighbors)
    assert np.array_equal(given, normals_of(points, k=16))
    # Neighbours from a plane z = 0 give its normal, whatever the search would find.
    flat = jnp.concatenate([points, jnp.asarray(plane((0, 0, 1), 20), jnp.float32)])
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
    "isotropic": np.concatenate([np.eye(3), -np.eye(3)]),
    "tiny": 1e-12 * sphere(20),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_neighborhoods_give_unit_vectors(name):
    points = jnp.asarray(DEGENERATE[name], jnp.float32)
    found = np.asarray(normals_of(points))
    assert found.shape == points.shape
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.array_equal(found, normals_of(points))
    if name in ("one point", "coincident"):
        assert np.array_equal(found, np.broadcast_to([1.0, 0, 0], found.shape))
    if name in ("two points", "collinear", "on an axis"):
        direction = DEGENERATE[name][-1] / np.linalg.norm(DEGENERATE[name][-1])
        assert agreement(found, direction).max() < 1e-5


@pytest.mark.parametrize("name", ["isotropic", "coincident", "one point"])
def test_no_gradient_flows(name):
    points = jnp.asarray(DEGENERATE[name], jnp.float32)
    gradient = jax.grad(lambda p: (normals_of(p) * jnp.arange(3.0)).sum())(points)
    assert np.all(gradient == 0)


def test_vmap():
    clouds = np.stack([sphere(100), plane((1, 2, 3), 100).astype(np.float32)])
    found = jax.jit(jax.vmap(pca_normals))(clouds)
    for i in range(2):
        assert agreement(found[i], normals_of(clouds[i])).min() > 1 - 1e-5
