"""Resolutions and their neighbours against loops and SciPy's tree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.models.pyramid import build_pyramid, sampled_rows
from tests.geometry.test_neighbors import of_kind, squared

RNG = np.random.default_rng(0)
RATES, NEIGHBORS = (1, 2, 4), (5, 4, 3)


def cloud(count, kind="gaussian"):
    return jnp.asarray(of_kind(kind, RNG.normal(size=(count, 3))))


def pyramid(query, support):
    clouds = query, support
    orders = (sampled_rows(cloud, len(cloud) // 2) for cloud in clouds)
    return build_pyramid(*clouds, *orders, RATES, NEIGHBORS)


jit_pyramid = jax.jit(pyramid)


def assert_nearest(indices, query, support):
    """Compares distances, since equally near points may be listed in any order."""
    assert indices.min() >= 0 and indices.max() < len(support)
    found = squared(query, support, indices) ** 0.5
    expected = KDTree(np.float64(support)).query(query, indices.shape[1])[0]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "kind", ["gaussian", "duplicates", "collinear", "far", "identical"]
)
def test_every_level_finds_the_nearest_points(kind):
    query, support = cloud(48, kind), cloud(32, kind)
    levels = jit_pyramid(query, support)
    assert len(levels) == 3
    for i, level in enumerate(levels):
        assert level.neighbors.shape == (48 // RATES[i], NEIGHBORS[i])
        q, s = query[level.query_rows], support[level.support_rows]
        assert_nearest(level.neighbors, q, s)
        if i < 2:
            coarser = query[levels[i + 1].query_rows]
            assert_nearest(level.query_coarser, q, coarser)
            assert_nearest(level.support_coarser, s, coarser)
    assert levels[2].query_coarser is None and levels[2].support_coarser is None


def test_one_cloud_as_query_and_support():
    clouds = jnp.stack([cloud(32), cloud(32)])
    shared = jax.jit(jax.vmap(lambda points: pyramid(points, points)))(clouds)
    for i, points in enumerate(clouds):
        apart = jit_pyramid(points, points)
        one = jax.tree.map(lambda leaf, i=i: leaf[i], shared)
        assert jax.tree.all(jax.tree.map(np.array_equal, one, apart))
        for level in one:
            rows = np.arange(len(level.query_rows))
            np.testing.assert_array_equal(level.neighbors[:, 0], rows)


def test_fewer_points_than_neighbours_give_rows_that_exist():
    points = cloud(4)
    levels = jit_pyramid(points, points)
    for i, level in enumerate(levels):
        assert level.neighbors.shape == (4 // RATES[i], NEIGHBORS[i])
        assert 0 <= level.neighbors.min() <= level.neighbors.max() < 4 // RATES[i]
