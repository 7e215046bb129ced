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
jit_interpolate = jax.jit(three_point_interpolate)


def cloud(count: int, kind: str = "gaussian") -> np.ndarray:
    points = RNG.normal(size=(count, 3))
    if kind == "duplicates":
        points[count // 2 :] = points[: count - count // 2]
    if kind == "collinear":
        points = points[:, :1] * np.array([[1.0, 2.0, -1.0]])
    if kind == "grid":
        points = np.round(points * 2)
    if kind == "clustered":
        points = np.round(points) + 1e-3 * points
    if kind == "far":
        points = points + 1000.0
    return points.astype(np.float32)


KINDS = ["gaussian", "duplicates", "collinear", "grid", "clustered", "far"]
# Below, at and above the lengths of the runs and the size searched directly.
SIZES = [(1, 1), (7, 31), (40, 33), (60, 1024), (50, 1500)]
# And above those at which `top_k` takes the place of sorted lists.
MANY = [(SIZES[-1], 16), (SIZES[-1], 40), ((50, 4500), 16)]


def squared(query, support, indices):
    """Float64 squared distances to the supports with these indices."""
    query, support = (np.asarray(cloud, np.float64) for cloud in (query, support))
    return ((query[:, None] - support[np.asarray(indices)]) ** 2).sum(-1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sizes", SIZES)
def test_nearest_agrees_with_a_tree(sizes, kind):
    query, support = cloud(sizes[0], kind), cloud(sizes[1], kind)
    distances, indices = jit_nearest(query, support)
    expected = KDTree(np.float64(support)).query(np.float64(query))[0] ** 2
    assert np.allclose(distances, expected, rtol=1e-5, atol=1e-12)
    assert np.allclose(squared(query, support, indices[:, None])[:, 0], distances)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("sizes", "k"), [*[(s, 3) for s in SIZES[1:]], *MANY])
def test_knn_agrees_with_a_tree(sizes, k, kind):
    query, support = cloud(sizes[0], kind), cloud(sizes[1], kind)
    indices = np.asarray(jit_knn(query, support, k))
    expected = KDTree(np.float64(support)).query(np.float64(query), k)[0] ** 2
    # Comparing distances, since equally near supports may be listed in any order.
    assert np.allclose(squared(query, support, indices), expected, rtol=1e-5, atol=1e-9)
    assert all(len(set(row)) == k for row in indices)


def test_blocks_of_queries_change_nothing(monkeypatch, support_size=2000):
    support = cloud(support_size)
    query = cloud(50) + np.float32(0.05)

    def found():
        """Compiled anew."""
        return jax.jit(lambda q, s: (*nearest(q, s), knn(q, s, 4)))(query, support)

    whole = found()
    for name in ("_NEAREST_PAIRS", "_KNN_PAIRS"):
        assert query.shape[0] * support_size <= getattr(neighbors, name)
        monkeypatch.setattr(neighbors, name, 7 * support_size)
    assert all(map(np.array_equal, found(), whole))


def test_a_point_finds_itself_first():
    points = cloud(1500)
    assert np.array_equal(jit_knn(points, points, 16)[:, 0], np.arange(1500))
    distances, indices = jit_nearest(points, points)
    assert np.all(distances == 0) and np.array_equal(indices, np.arange(1500))


def test_knn_agrees_with_the_reference_model(golden):
    ops = golden("ops.npz")
    for query, support, expected in zip(
        ops["knn/query"], ops["knn/support"], ops["knn/idx16"], strict=True
    ):
        found = np.asarray(jit_knn(query, support, 16))
        assert np.array_equal(np.sort(found, axis=1), np.sort(expected, axis=1))


@pytest.mark.parametrize("support_size", [3, 40, 2000])
def test_ties_go_to_the_lowest_index(support_size):
    support = jnp.ones((support_size, 3))
    # In 64ths, whose squares are exact: ties are ties however a compiler rounds.
    query = np.round(64 * cloud(50)) / np.float32(64)
    assert np.all(jit_nearest(query, support)[1] == 0)
    assert np.all(jit_knn(query, support, 3) == np.arange(3))


def test_too_few_supports_repeat_the_last():
    support = jnp.array([[0.0, 0, 0], [3.0, 0, 0]])
    indices = jit_knn(jnp.array([[2.0, 0, 0], [1.0, 0, 0]]), support, 4)
    assert np.array_equal(indices, [[1, 0, 0, 0], [0, 1, 1, 1]])
    assert np.array_equal(jit_knn(support[:1], support[:1], 3), [[0, 0, 0]])


def test_nearest_gradients(x64):
    query, support = (jnp.asarray(RNG.normal(size=(n, 3))) for n in (6, 9))
    check_grads(
        jax.jit(lambda q, s: nearest(q, s)[0] ** 2), (query, support), 2, ("rev",)
    )


def test_nearest_gradient_reaches_the_winners_alone():
    query, support = cloud(5), cloud(50)
    _, indices = jit_nearest(query, support)
    gradients = jax.grad(lambda q, s: jit_nearest(q, s)[0].sum(), (0, 1))(
        query, support
    )
    to_query = 2 * (query - support[np.asarray(indices)])
    to_support = np.zeros_like(support)
    np.add.at(to_support, np.asarray(indices), -to_query)
    assert np.allclose(gradients[0], to_query, atol=1e-6)
    assert np.allclose(gradients[1], to_support, atol=1e-6)


def test_coincident_points_have_a_zero_gradient():
    points = jnp.asarray(np.repeat(cloud(1), 5, axis=0))
    gradients = jax.grad(lambda q, s: jit_nearest(q, s)[0].sum(), (0, 1))(
        points, points
    )
    assert all(np.all(g == 0) for g in gradients)


def test_nearest_takes_linear_memory():
    """Also through the gradient: far less than one number for every pair."""

    def gradient(query, support):
        return jax.grad(lambda q: nearest(q, support)[0].sum())(query)

    count = 16384
    shape = jax.ShapeDtypeStruct((count, 3), jnp.float32)
    analysis = jax.jit(gradient).lower(shape, shape).compile().memory_analysis()
    assert analysis is not None
    assert analysis.temp_size_in_bytes < 0.05 * 4 * count**2


def test_interpolation_agrees_with_the_reference_model(golden):
    ops = golden("ops.npz")
    for query, support, features, expected in zip(
        ops["knn/query"],
        ops["knn/support"],
        ops["interp/feat"],
        ops["interp/out"],
        strict=True,
    ):
        found = jit_interpolate(query, support, features.T)
        assert np.allclose(found.T, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_interpolation_agrees_with_a_loop(kind):
    query, support = cloud(20, kind), cloud(30, kind)
    features = RNG.normal(size=(30, 4)).astype(np.float32)
    neighbors = jit_knn(query, support, 3)
    expected = []
    for point, indices in zip(query, np.asarray(neighbors), strict=True):
        weights = 1 / (squared(point[None], support, indices[None])[0] + 1e-8)
        expected.append(weights @ np.float64(features[indices]) / weights.sum())
    found = jit_interpolate(query, support, features)
    assert np.allclose(found, expected, rtol=1e-4, atol=1e-5)
    given = jit_interpolate(query, support, features, neighbors)
    assert np.array_equal(given, found)


def test_interpolation_at_a_support_returns_its_feature():
    support, features = jnp.asarray(cloud(40)), jnp.asarray(cloud(40))
    found = jit_interpolate(support, support, features)
    assert np.allclose(found, features, atol=1e-4)
    one = jit_interpolate(support, support[:1], features[:1])
    assert np.allclose(one, jnp.broadcast_to(features[:1], one.shape), atol=1e-6)


def test_interpolation_gradients(x64):
    query, support, features = (jnp.asarray(RNG.normal(size=(n, 3))) for n in (4, 6, 6))
    check_grads(
        jax.jit(three_point_interpolate), (query, support, features), 2, ("rev",)
    )


def test_interpolation_of_coincident_points_has_finite_gradients():
    points = jnp.ones((5, 3))
    gradients = jax.grad(lambda *x: (jit_interpolate(*x) ** 2).sum(), (0, 1, 2))(
        points, points, jnp.asarray(cloud(5))
    )
    assert all(np.all(np.isfinite(g)) for g in gradients)


def test_vmap():
    queries, supports = cloud(60).reshape(2, 30, 3), cloud(80).reshape(2, 40, 3)
    distances, indices = jax.jit(jax.vmap(nearest))(queries, supports)
    neighbors = jax.jit(jax.vmap(lambda q, s: knn(q, s, 4)))(queries, supports)
    features = jax.jit(jax.vmap(three_point_interpolate))(queries, supports, supports)
    for i in range(2):
        pair = (queries[i], supports[i])
        assert np.array_equal(distances[i], jit_nearest(*pair)[0])
        assert np.array_equal(indices[i], jit_nearest(*pair)[1])
        assert np.array_equal(neighbors[i], jit_knn(*pair, 4))
        assert np.allclose(features[i], jit_interpolate(*pair, supports[i]), atol=1e-6)


def test_an_empty_support_is_refused():
    with pytest.raises(ValueError, match="at least one point to find"):
        knn(jnp.zeros((3, 3)), jnp.zeros((0, 3)), 2)
    with pytest.raises(ValueError, match="at least one point to find"):
        nearest(jnp.zeros((3, 3)), jnp.zeros((0, 3)))


@pytest.mark.parametrize(("count", "k"), [(100, 4), (1000, 4), (1000, 60)])
def test_indices_have_32_bits_whatever_the_default(x64, count, k):
    points = jnp.asarray(cloud(count))
    assert jax.eval_shape(lambda p: knn(p, p, k), points).dtype == jnp.int32
    assert jax.eval_shape(nearest, points, points)[1].dtype == jnp.int32
