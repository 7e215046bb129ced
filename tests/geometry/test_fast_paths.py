"""Every fast path against its plain form, on clouds that are hard on searches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.geometry.neighbors import knn, nearest
from prism_jax.geometry.normals import pca_normals
from prism_jax.geometry.sampling import farthest_point_sample
from prism_jax.losses.chamfer import chamfer

KINDS = ["random", "clustered", "planar", "duplicated", "collinear"]
SEEDS = range(3)
# Above neighbors._DIRECT_SUPPORT, so that every search takes two levels.
SIZE = 1300

nearest_of = jax.jit(nearest)
knn_of = jax.jit(knn, static_argnums=2)
farthest_of = jax.jit(farthest_point_sample, static_argnums=1)
normals_of = jax.jit(pca_normals)
chamfer_of = jax.jit(jax.value_and_grad(chamfer, argnums=(0, 1)))


def cloud(kind: str, seed: int, size: int) -> np.ndarray:
    rng = np.random.default_rng([KINDS.index(kind), seed, size])
    points = rng.uniform(-1, 1, (size, 3))
    if kind == "clustered":
        points = rng.uniform(-1, 1, (7, 3))[rng.integers(0, 7, size)] + 1e-2 * points
    elif kind == "planar":
        points = points[:, :2] @ rng.normal(size=(2, 3))
    elif kind == "duplicated":
        points = points[rng.integers(0, size // 10, size)]
    elif kind == "collinear":
        points = points[:, :1] * rng.normal(size=3)
    return points.astype(np.float32)


def squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return ((a[:, None].astype(np.float64) - b[None]) ** 2).sum(-1)


@pytest.fixture(params=[(kind, seed) for kind in KINDS for seed in SEEDS], ids=str)
def drawn(request):
    return request.param


@pytest.fixture
def clouds(drawn):
    kind, seed = drawn
    return cloud(kind, seed, 400), cloud(kind, seed + 100, SIZE)


def test_nearest(clouds):
    query, support = clouds
    distances, indices = nearest_of(*map(jnp.asarray, clouds))
    every = squared_distances(query, support)
    np.testing.assert_allclose(distances, every.min(1), rtol=1e-5, atol=1e-10)
    chosen = every[np.arange(len(query)), np.asarray(indices)]
    np.testing.assert_allclose(chosen, every.min(1), rtol=1e-5, atol=1e-10)


@pytest.mark.parametrize(("size", "k"), [(200, 8), (1300, 3), (1300, 40), (4500, 16)])
def test_knn(drawn, size, k):
    """Sorted lists of points and of runs, and where ``top_k`` takes their place."""
    kind, seed = drawn
    query, support = cloud(kind, seed, 400), cloud(kind, seed + 100, size)
    indices = np.asarray(knn_of(jnp.asarray(query), jnp.asarray(support), k))
    every = squared_distances(query, support)
    found = np.take_along_axis(every, indices, 1)
    expected = np.sort(every, axis=1)[:, :k]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-10)
    assert all(len(set(row)) == k for row in indices.tolist())


def test_farthest_points(clouds):
    _, points = clouds
    chosen = np.asarray(farthest_of(jnp.asarray(points), 64))
    # Whatever ties and rounding do, every sample is as far as any point could be.
    distances = squared_distances(points, points[chosen])
    before = np.minimum.accumulate(distances, axis=1)
    for i in range(1, 64):
        farthest = before[:, i - 1].max()
        assert before[chosen[i], i - 1] >= farthest * (1 - 1e-5) - 1e-10


def test_chamfer_and_its_gradient(clouds):
    a, b = clouds
    value, gradients = chamfer_of(*map(jnp.asarray, clouds))
    every = squared_distances(a, b)
    expected = every.min(1).mean() + every.min(0).mean()
    np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-10)
    # Points whose pairs are in no doubt: of several as near, any may have the gradient.
    to_b, to_a = every.argmin(1), every.argmin(0)
    first = 2 * (a - b[to_b]) / len(a)
    np.add.at(first, to_a, 2 * (a[to_a] - b) / len(b))
    unique = np.sort(every, 1)[:, 1] > 1.0001 * every.min(1) + 1e-9
    unique[ambiguous(every)] = False
    np.testing.assert_allclose(
        np.asarray(gradients[0])[unique], first[unique], rtol=1e-3, atol=1e-7
    )


def ambiguous(every: np.ndarray) -> np.ndarray:
    """Rows of ``a`` that some point of ``b`` has for one of several nearest."""
    near = every <= 1.0001 * every.min(0) + 1e-9
    return np.flatnonzero((near & (near.sum(0) > 1)).any(1))


def test_normals(clouds):
    _, points = clouds
    found = np.asarray(normals_of(jnp.asarray(points)), np.float64)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-5)
    neighbors = np.argsort(squared_distances(points, points), axis=1)[:, :16]
    offsets = points[neighbors].astype(np.float64)
    offsets -= offsets.mean(1, keepdims=True)
    covariance = np.einsum("nki,nkj->nij", offsets, offsets)
    values = np.linalg.eigvalsh(covariance)
    along = np.einsum("ni,nij,nj->n", found, covariance, found)
    # The variance along it is the least, whichever of equal directions it is.
    assert (along <= values[:, 0] + 1e-5 * values[:, 2] + 1e-12).all()
