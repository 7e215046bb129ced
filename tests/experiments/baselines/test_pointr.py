"""PoinTr: its parts against loops, Flax and PyTorch; the whole by what it promises."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.baselines.pointr import (
    Attention,
    Block,
    EdgeConv,
    GeometryAwareAttention,
    NormMLP,
    PoinTr,
    PoinTrConfig,
    proxy_indices,
)

RNG = np.random.default_rng(0)
TINY = PoinTrConfig(
    num_points=64,
    num_centers=(32, 16),
    center_features=(4, 8, 8, 8, 8),
    center_neighbors=4,
    norm_groups=2,
    features=16,
    num_heads=2,
    depth=(1, 1),
    block_neighbors=4,
    position_features=8,
    global_features=16,
    num_queries=8,
    fold_side=2,
    fold_features=(16, 8),
    use_norm=False,
)


def normal(*shape, scale=1.0):
    """Single precision, or double in the tests of gradients."""
    return jnp.asarray(scale * RNG.normal(size=shape), jnp.result_type(float))


def integers(high, *shape):
    return jnp.asarray(RNG.integers(0, high, shape))


def shapes(module, *inputs):
    return jax.eval_shape(lambda: module.init(jax.random.key(0), *inputs))


def randomised(module, *inputs):
    """Variables of the module, biases included, drawn anew."""
    tree = shapes(module, *inputs)
    return jax.tree.map(lambda leaf: normal(*leaf.shape, scale=0.5), tree)


def farthest(cloud, count):
    """Rows by the definition, in double precision."""
    cloud = np.float64(cloud)
    distances, rows = np.full(len(cloud), np.inf), [0]
    while len(rows) < count:
        distances = np.minimum(distances, ((cloud - cloud[rows[-1]]) ** 2).sum(-1))
        rows.append(int(distances.argmax()))
    return rows


PARTIAL = normal(3, 64, 3)
FARTHEST = np.array([[cloud[i] for i in farthest(cloud, 16)] for cloud in PARTIAL])
VARIABLES = jax.tree.map(
    lambda leaf: normal(
        *leaf.shape, scale=(leaf.shape[0] if leaf.ndim > 1 else 100) ** -0.5
    ),
    shapes(PoinTr(TINY), PARTIAL),
)


@pytest.fixture(scope="module")
def complete_fn(quick_jit):
    return quick_jit(PoinTr(TINY).apply)


def test_samples_and_neighbours_of_the_partial():
    fn = jax.jit(proxy_indices, static_argnums=1)
    indices = jax.tree.map(np.asarray, fn(PARTIAL[0], TINY))
    cloud = np.float64(PARTIAL[0])
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


@pytest.mark.parametrize("num_groups", [None, 2])
def test_edge_convolution(num_groups, quick_jit):
    query, support = normal(2, 7, 5), normal(2, 9, 5)
    neighbors = integers(9, 2, 7, 3)
    module = EdgeConv(6, num_groups)
    variables = randomised(module, query, support, neighbors)
    made = quick_jit(module.apply)(variables, query, support, neighbors)
    for cloud in range(2):
        given = (query[cloud], support[cloud], neighbors[cloud], num_groups)
        expected = edge_conv_by_hand(variables["params"], *given)
        np.testing.assert_allclose(made[cloud], expected, rtol=1e-4, atol=1e-5)


def test_attention(quick_jit):
    query, support = normal(2, 5, 12), normal(2, 7, 12)
    module = Attention(3)
    variables = randomised(module, query, support)
    params = jax.tree.map(np.asarray, variables["params"])
    heads = (
        (np.asarray(x) @ params[name]).reshape(2, -1, 3, 4)
        for name, x in (("query", query), ("key", support), ("value", support))
    )
    attended = np.asarray(quick_jit(nn.dot_product_attention)(*heads))
    expected = attended.reshape(2, 5, 12) @ params["end"]["kernel"]
    made = quick_jit(module.apply)(variables, query, support)
    expected += params["end"]["bias"]
    np.testing.assert_allclose(made, expected, rtol=1e-5, atol=1e-5)


def test_geometry_joins_attention_and_edges(quick_jit):
    query, support = normal(5, 12), normal(7, 12)
    neighbors = integers(7, 5, 3)
    module = GeometryAwareAttention(3)
    variables = randomised(module, query, support, neighbors)
    params = variables["params"]
    attention = {"params": {"attention": params["attention"]}}
    attended = quick_jit(lambda v: module.apply(v, query, support, None))(attention)
    local = edge_conv_by_hand(params["geometry"], query, support, neighbors, None)
    merge = jax.tree.map(np.asarray, params["merge"]["dense_0"])
    expected = np.concatenate([attended, local], -1) @ merge["kernel"] + merge["bias"]
    made = quick_jit(module.apply)(variables, query, support, neighbors)
    np.testing.assert_allclose(made, expected, rtol=1e-4, atol=1e-5)


def test_block_is_pytorchs_decoder_layer(quick_jit):
    """Of normalised memory, without biases of queries, keys and values."""
    torch = pytest.importorskip("torch")
    x, encoded = normal(2, 5, 12), normal(2, 7, 12)
    module = Block(num_heads=3, mlp_ratio=2)
    variables = randomised(module, x, None, encoded)
    p = jax.tree.map(lambda leaf: torch.tensor(np.asarray(leaf)), variables["params"])
    layer = torch.nn.TransformerDecoderLayer(
        12, 3, 24, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
    )
    state = {
        name: torch.zeros_like(value) for name, value in layer.state_dict().items()
    }
    for theirs, ours in (("self_attn", "self"), ("multihead_attn", "cross")):
        attention = p[f"{ours}_attention"]["attention"]
        kernels = [attention[name] for name in ("query", "key", "value")]
        state[f"{theirs}.in_proj_weight"] = torch.cat(kernels, dim=1).T
        state |= linear(f"{theirs}.out_proj", attention["end"])
    for i, name in enumerate(("norm_self", "norm_query", "norm_mlp")):
        state[f"norm{i + 1}.weight"] = p[name]["scale"]
        state[f"norm{i + 1}.bias"] = p[name]["bias"]
    state |= linear("linear1", p["mlp_0"]) | linear("linear2", p["mlp_1"])
    layer.load_state_dict(state)
    norm = (p["norm_key"]["scale"], p["norm_key"]["bias"])
    memory = torch.nn.functional.layer_norm(
        torch.tensor(np.asarray(encoded)), (12,), *norm
    )
    expected = layer(torch.tensor(np.asarray(x)), memory).detach()
    made = quick_jit(module.apply)(variables, x, None, encoded)
    np.testing.assert_allclose(made, expected, rtol=1e-4, atol=1e-4)


def linear(name, dense):
    return {f"{name}.weight": dense["kernel"].T, f"{name}.bias": dense["bias"]}


def test_mlp_joins_its_inputs_and_leaks(quick_jit):
    fine, coarse = normal(2, 6, 3), normal(2, 2, 4)
    module = NormMLP((5, 4), use_norm=False)
    variables = randomised(module, fine, coarse)
    params = jax.tree.map(np.asarray, variables["params"])
    first, last = params["dense_0"], params["dense_1"]
    x = np.concatenate([fine, np.repeat(coarse, 3, axis=1)], -1)
    x = x @ first["kernel"] + first["bias"]
    x = np.where(x > 0, x, 0.2 * x)
    expected = x @ last["kernel"] + last["bias"]
    made = quick_jit(module.apply)(variables, fine, coarse)
    np.testing.assert_allclose(made, expected, rtol=1e-5, atol=1e-5)


def test_what_is_appended_and_what_is_folded(complete_fn):
    coarse, dense = complete_fn(VARIABLES, PARTIAL)
    np.testing.assert_array_equal(coarse[:, 8:], FARTHEST[:, :8])
    np.testing.assert_array_equal(dense[:, 32:], PARTIAL)
    # Without a last layer, every folded point lies on its centre.
    flat = jax.tree.map(lambda leaf: leaf, VARIABLES)
    fold = flat["params"]["fold_1"]
    fold["dense_2"] = jax.tree.map(jnp.zeros_like, fold["dense_2"])
    again, folded = complete_fn(flat, PARTIAL)
    np.testing.assert_array_equal(again, coarse)
    np.testing.assert_array_equal(folded[:, :32], np.repeat(coarse[:, :8], 4, axis=1))
    patches = np.asarray(dense[:, :32] - folded[:, :32]).reshape(-1, 4, 3)
    assert (np.ptp(patches, axis=1).max(-1) > 1e-4).all()


def test_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match="64 points"):
        PoinTr(TINY).apply(VARIABLES, PARTIAL[:, :63])
    with pytest.raises(ValueError, match="centers"):
        dataclasses.replace(TINY, num_queries=33)
