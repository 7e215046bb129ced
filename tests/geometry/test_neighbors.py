"""Neighbour search against SciPy's tree, interpolation against the reference model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial import KDTree

from prism_jax.geometry import neighbors
from prism_jax.geometry.neighbors import knn, nearest, three_point_interpolate

RNG = np.random.default_rng(0)
jit_nearest = jax.jit(nearest)
jit_knn = jax.jit(knn, static_argnums=2)


def interpolate(query, support, features):
    near = knn(query, support, 3)
    return three_point_interpolate(query, support, features, near)


jit_interpolate = jax.jit(interpolate)


def of_kind(kind: str, points: np.ndarray) -> np.ndarray:
    """Points, moved so that they are hard for a search in some way."""
    if kind == "duplicates":
        points = points[np.arange(len(points)) % (len(points) // 2 + 1)]
    if kind == "planar":
        points = points * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.5]
    if kind == "collinear":
        points = points[:, :1] * [[1.0, 2.0, -1.0]]
    if kind == "identical":
        points = np.repeat(points[:1], len(points), axis=0)
    if kind == "grid":
        points = np.round(points * 2)
    if kind == "clustered":
        points = np.round(points) + 1e-3 * points
    if kind == "far":
        points = points + [1000.0, -2000.0, 500.0]
    return points.astype(np.float32)


KINDS = ["gaussian", "duplicates", "collinear", "grid", "clustered", "far"]


def cloud(count: int, kind: str = "gaussian") -> np.ndarray:
    return of_kind(kind, RNG.normal(size=(count, 3)))


def pairs(num_queries, num_supports):
    """A query and a support of every kind, and points of a support sought in it."""
    found = [(cloud(num_queries, kind), cloud(num_supports, kind)) for kind in KINDS]
    support = cloud(num_supports)
    return [*found, (support[:num_queries], support)]


def squared(query, support, indices):
    """Float64 squared distances to the supports with these indices."""
    query, support = (np.asarray(cloud, np.float64) for cloud in (query, support))
    return ((query[:, None] - support[np.asarray(indices)]) ** 2).sum(-1)


# One run, some of which the last is full, and some of which it is not.
@pytest.mark.parametrize("sizes", [(1, 1), (50, 1024), (50, 1500)])
def test_nearest_agrees_with_a_tree(sizes):
    for query, support in pairs(*sizes):
        distances, indices = jit_nearest(query, support)
        expected = KDTree(np.float64(support)).query(np.float64(query))[0] ** 2
        assert np.allclose(distances, expected, rtol=1e-5, atol=1e-12)
        assert np.allclose(squared(query, support, indices[:, None])[:, 0], distances)


# Searched directly or by runs, of which there may be many; by sorted lists or `top_k`.
@pytest.mark.parametrize(
    ("sizes", "k"),
    [((7, 31), 3), ((50, 100), 40), ((50, 1500), 16), ((50, 1500), 40)]
    + [((50, 4500), 16)],
)
def test_knn_agrees_with_a_tree(sizes, k):
    for query, support in pairs(*sizes):
        indices = np.asarray(jit_knn(query, support, k))
        expected = KDTree(np.float64(support)).query(np.float64(query), k)[0] ** 2
        # Of distances, since equally near supports may be listed in any order.
        found = squared(query, support, indices)
        assert np.allclose(found, expected, rtol=1e-5, atol=1e-9)
        assert all(len(set(row)) == k for row in indices)


def test_blocks_of_queries_change_nothing(monkeypatch):
    query, support = cloud(50), cloud(1500)
    whole = *jit_nearest(query, support), jit_knn(query, support, 16)
    for name in ("_NEAREST_PAIRS", "_KNN_PAIRS"):
        assert query.shape[0] * support.shape[0] <= getattr(neighbors, name)
        monkeypatch.setattr(neighbors, name, 7 * support.shape[0])
    blocks = jax.jit(lambda q, s: (*nearest(q, s), knn(q, s, 16)))(query, support)
    assert all(map(np.array_equal, blocks, whole))


@pytest.mark.parametrize(("sizes", "k"), [((7, 31), 3), ((50, 1500), 16)])
def test_ties_go_to_the_lowest_index(sizes, k):
    support = jnp.ones((sizes[1], 3))
    # In 64ths, whose squares are exact: ties are ties however a compiler rounds.
    query = np.round(64 * cloud(sizes[0])) / np.float32(64)
    assert np.all(jit_nearest(query, support)[1] == 0)
    assert np.all(jit_knn(query, support, k) == np.arange(k))


def test_too_few_supports_repeat_the_last_and_none_are_refused():
    support = jnp.array([[0.0, 0, 0], [3.0, 0, 0]])
    indices = jit_knn(jnp.array([[2.0, 0, 0], [1.0, 0, 0]]), support, 4)
    assert np.array_equal(indices, [[1, 0, 0, 0], [0, 1, 1, 1]])
    for search in (nearest, lambda query, support: knn(query, support, 2)):
        with pytest.raises(ValueError, match="at least one point to find"):
            search(support, support[:0])


def test_agrees_with_the_reference_model(golden):
    ops = golden("ops.npz")
    for query, support, expected, features, out in zip(
        ops["knn/query"],
        ops["knn/support"],
        ops["knn/idx16"],
        ops["interp/feat"],
        ops["interp/out"],
        strict=True,
    ):
        found = np.asarray(jit_knn(query, support, 16))
        assert np.array_equal(np.sort(found, axis=1), np.sort(expected, axis=1))
        found = jit_interpolate(query, support, features.T)
        assert np.allclose(found.T, out, atol=1e-6, rtol=0)


def test_gradients(x64):
    """Of distances, and of what is interpolated."""
    query, support, features = (jnp.asarray(RNG.normal(size=(n, 3))) for n in (4, 6, 6))

    def both(query, support, features):
        found = interpolate(query, support, features)
        return nearest(query, support)[0] ** 2, found

    check_grads(jax.jit(both), (query, support, features), 2, ("rev",))


def test_coincident_points_have_a_finite_gradient():
    points = jnp.ones((7, 3))

    @jax.jit
    def both(*points):
        return nearest(*points[:2])[0].sum(), interpolate(*points).sum()

    apart, interpolated = jax.jacrev(both, (0, 1, 2))(points, points, points)
    assert all(np.all(g == 0) for g in apart)
    assert all(np.all(np.isfinite(g)) for g in interpolated)


def test_vmap():
    def every(query, support):
        found = interpolate(query, support, support)
        return *nearest(query, support), knn(query, support, 3), found

    queries, supports = cloud(14).reshape(2, 7, 3), cloud(62).reshape(2, 31, 3)
    found = jax.jit(jax.vmap(every))(queries, supports)
    for i, pair in enumerate(zip(queries, supports, strict=True)):
        expected = (
            *jit_nearest(*pair),
            jit_knn(*pair, 3),
            jit_interpolate(*pair, pair[1]),
        )
        assert all(map(np.array_equal, (rows[i] for rows in found[:3]), expected[:3]))
        assert np.allclose(found[3][i], expected[3], atol=1e-6)


def test_indices_have_32_bits_whatever_the_default(x64):
    for count, k in ((100, 4), (1000, 4), (1000, 60)):
        points = jax.ShapeDtypeStruct((count, 3), jnp.float64)
        assert jax.eval_shape(lambda p, k=k: knn(p, p, k), points).dtype == jnp.int32
        assert jax.eval_shape(nearest, points, points)[1].dtype == jnp.int32
