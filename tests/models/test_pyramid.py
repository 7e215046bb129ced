"""Resolutions and their neighbours against loops and SciPy's tree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.models.pyramid import build_pyramid, farthest_order, resolution_rows

RNG = np.random.default_rng(0)
RATES, NEIGHBORS = (1, 2, 4), (5, 4, 3)


def cloud(count, kind="gaussian"):
    points = RNG.normal(size=(count, 3))
    if kind == "duplicates":
        points[count // 4 :] = points[: count - count // 4]
    if kind == "collinear":
        points = points[:, :1] * np.array([[1.0, 2.0, -1.0]])
    if kind == "far":
        points = points + 1000.0
    if kind == "identical":
        points[:] = points[0]
    return jnp.asarray(points, jnp.float32)


def pyramid(query, support, same=False):
    def rows(cloud):
        return resolution_rows(
            farthest_order(cloud, len(cloud) // 2), len(cloud), RATES
        )

    return build_pyramid(query, support, rows(query), rows(support), NEIGHBORS, same)


jit_pyramid = jax.jit(pyramid, static_argnums=2)


def assert_nearest(indices, query, support):
    """Compares distances, since equally near points may be listed in any order."""
    indices, query, support = (
        np.asarray(indices),
        np.float64(query),
        np.float64(support),
    )
    assert indices.min() >= 0 and indices.max() < len(support)
    found = np.linalg.norm(query[:, None] - support[indices], axis=-1)
    expected = KDTree(support).query(query, indices.shape[1])[0]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", ["gaussian", "duplicates", "collinear", "far"])
def test_every_level_finds_the_nearest_points(kind):
    query, support = cloud(48, kind), cloud(32, kind)
    levels = jit_pyramid(query, support)
    assert len(levels) == 3
    for i, level in enumerate(levels):
        assert level.query_rows.shape == (48 // RATES[i],)
        assert level.support_rows.shape == (32 // RATES[i],)
        assert level.neighbors.shape == (48 // RATES[i], NEIGHBORS[i])
        q, s = query[level.query_rows], support[level.support_rows]
        assert_nearest(level.neighbors, q, s)
        if i < 2:
            coarser = query[levels[i + 1].query_rows]
            assert_nearest(level.query_coarser, q, coarser)
            assert_nearest(level.support_coarser, s, coarser)
    assert levels[2].query_coarser is None and levels[2].support_coarser is None


def test_resolutions_are_prefixes_of_one_order():
    points = cloud(40)
    order = np.asarray(farthest_order(points, 20))
    rows = resolution_rows(jnp.asarray(order), 40, (1, 2, 5))
    np.testing.assert_array_equal(rows[0], np.arange(40))
    np.testing.assert_array_equal(rows[1], order)
    np.testing.assert_array_equal(rows[2], order[:8])
    # Sampling the coarser resolution from the whole cloud is the same.
    np.testing.assert_array_equal(farthest_order(points, 8), order[:8])


def test_a_sampled_cloud_is_in_farthest_point_order():
    points = cloud(60, "duplicates")
    sampled = points[farthest_order(points, 30)]
    np.testing.assert_array_equal(sampled[farthest_order(sampled, 15)], sampled[:15])


def test_points_near_the_origin_are_left_out():
    points = np.array(cloud(40))
    points[5:20] *= 0.01 / np.linalg.norm(points[5:20], axis=1, keepdims=True)
    points = jnp.asarray(points)
    order = np.asarray(farthest_order(points, 20))
    assert order[0] == 0
    assert not set(order) & set(range(5, 20))
    distances = np.linalg.norm(points[:, None] - points[order[:-1]][None], axis=-1)
    for i in range(1, 20):
        nearest = distances[:, :i].min(1)
        nearest[5:20] = -1
        assert nearest[order[i]] == nearest.max()


def test_one_cloud_as_query_and_support():
    points = cloud(32)
    shared, apart = jit_pyramid(points, points, True), jit_pyramid(points, points)
    assert jax.tree.all(jax.tree.map(np.array_equal, shared, apart))
    for level in shared:
        rows = np.arange(len(level.query_rows))
        np.testing.assert_array_equal(level.neighbors[:, 0], rows)


@pytest.mark.parametrize(("kind", "count"), [("identical", 16), ("gaussian", 4)])
def test_degenerate_clouds_give_rows_that_exist(kind, count):
    """Repeated points, and fewer points than neighbours."""
    points = cloud(count, kind)
    levels = jit_pyramid(points, points)
    for i, level in enumerate(levels):
        assert level.neighbors.shape == (count // RATES[i], NEIGHBORS[i])
        for indices, rows in (
            (level.neighbors, level.support_rows),
            (level.query_coarser, levels[min(i + 1, 2)].query_rows),
        ):
            if indices is not None:
                assert indices.min() >= 0 and indices.max() < len(rows)


def test_vmap_and_no_gradient():
    clouds = jnp.stack([cloud(32), cloud(32)])
    mapped = jax.jit(jax.vmap(lambda q: pyramid(q, q)))(clouds)
    for i, points in enumerate(clouds):
        alone = jit_pyramid(points, points)
        one = jax.tree.map(lambda leaf, i=i: leaf[i], mapped)
        assert jax.tree.all(jax.tree.map(np.array_equal, one, alone))
    leaves = jax.tree.leaves(mapped)
    assert all(jnp.issubdtype(leaf.dtype, jnp.integer) for leaf in leaves)
