"""PoinTr: its parts against loops and Flax, the whole by what it promises."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from experiments.baselines.pointr import (
    Attention,
    EdgeConv,
    GeometryAwareAttention,
    proxy_indices,
)
from tests.trees import drawn

RNG = np.random.default_rng(0)


def normal(*shape):
    return jnp.asarray(RNG.normal(size=shape), jnp.float32)


def farthest(cloud, count):
    """Rows by the definition, in double precision."""
    cloud = np.float64(cloud)
    distances, rows = np.full(len(cloud), np.inf), [0]
    while len(rows) < count:
        distances = np.minimum(distances, ((cloud - cloud[rows[-1]]) ** 2).sum(-1))
        rows.append(int(distances.argmax()))
    return rows


def test_samples_and_neighbours_of_the_partial(tiny_network, quick_jit):
    pointr = tiny_network("pointr")
    fn = quick_jit(proxy_indices, static_argnums=1)
    indices = jax.tree.map(np.asarray, fn(pointr.partial[0], pointr.network.config))
    cloud = np.float64(pointr.partial[0])
    rows = farthest(cloud, 32)
    np.testing.assert_array_equal(indices.rows, rows)
    for found, points in (
        (indices.neighbors, cloud),
        (indices.center_neighbors, cloud[rows]),
        (indices.proxy_neighbors, cloud[rows[:16]]),
    ):
        np.testing.assert_array_equal(found, KDTree(points).query(points, 4)[1])


def edge_conv_by_hand(params, query, support, neighbors, num_groups):
    """The definition, edge by edge, in double precision."""
    params = jax.tree.map(np.float64, params)
    query, support = np.float64(query), np.float64(support)
    edges = [
        [np.concatenate([support[j] - x, x]) for j in near]
        for x, near in zip(query, neighbors, strict=True)
    ]
    edges = np.array(edges) @ params["kernel"]
    if num_groups is None:
        edges += params["bias"]
    else:
        for group in np.split(np.arange(edges.shape[-1]), num_groups):
            values = edges[..., group]
            edges[..., group] = (values - values.mean()) / np.sqrt(values.var() + 1e-5)
        edges = edges * params["norm"]["scale"] + params["norm"]["bias"]
    return np.where(edges > 0, edges, 0.2 * edges).max(1)


def test_edge_convolution_with_group_norm(quick_jit):
    query, support = normal(2, 7, 5), normal(2, 9, 5)
    neighbors = jnp.asarray(RNG.integers(0, 9, (2, 7, 3)))
    module = EdgeConv(6, 2)
    variables = drawn(module, query, support, neighbors)
    made = quick_jit(module.apply)(variables, query, support, neighbors)
    for cloud in range(2):
        given = (query[cloud], support[cloud], neighbors[cloud], 2)
        expected = edge_conv_by_hand(variables["params"], *given)
        np.testing.assert_allclose(made[cloud], expected, rtol=1e-4, atol=1e-5)


def test_geometry_joins_attention_and_edges(quick_jit):
    """Attention is that of Flax."""
    query, support = normal(5, 12), normal(7, 12)
    neighbors = jnp.asarray(RNG.integers(0, 7, (5, 3)))
    module = GeometryAwareAttention(3)
    variables = drawn(module, query, support, neighbors)
    params = jax.tree.map(np.asarray, variables["params"])
    own = params["attention"]
    heads = (
        (np.asarray(x) @ own[name]).reshape(1, -1, 3, 4)
        for name, x in (("query", query), ("key", support), ("value", support))
    )
    attended = np.asarray(quick_jit(nn.dot_product_attention)(*heads)).reshape(5, 12)
    attended = attended @ own["end"]["kernel"] + own["end"]["bias"]
    alone = quick_jit(Attention(3).apply)({"params": own}, query, support)
    np.testing.assert_allclose(alone, attended, rtol=1e-5, atol=1e-5)
    local = edge_conv_by_hand(params["geometry"], query, support, neighbors, None)
    merge = params["merge"]["dense_0"]
    expected = np.concatenate([attended, local], -1) @ merge["kernel"] + merge["bias"]
    made = quick_jit(module.apply)(variables, query, support, neighbors)
    np.testing.assert_allclose(made, expected, rtol=1e-4, atol=1e-5)


def test_what_is_appended_and_what_is_folded(tiny_network):
    _, variables, partial, apply = tiny_network("pointr")
    coarse, dense = apply(variables, partial)
    seen = np.array([cloud[farthest(cloud, 8)] for cloud in np.asarray(partial)])
    np.testing.assert_array_equal(coarse[:, 8:], seen)
    np.testing.assert_array_equal(dense[:, 32:], partial)
    # Without a last layer, every folded point lies on its centre.
    flat = jax.tree.map(lambda leaf: leaf, variables)
    fold = flat["params"]["fold_1"]
    fold["dense_2"] = jax.tree.map(jnp.zeros_like, fold["dense_2"])
    again, folded = apply(flat, partial)
    np.testing.assert_array_equal(again, coarse)
    np.testing.assert_array_equal(folded[:, :32], np.repeat(coarse[:, :8], 4, axis=1))
    patches = np.asarray(dense[:, :32] - folded[:, :32]).reshape(-1, 4, 3)
    assert (np.ptp(patches, axis=1).max(-1) > 1e-4).all()
