"""PoinTr: its parts against loops, Flax and PyTorch; the whole by what it promises."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree
from jax.test_util import check_grads
from scipy.spatial import KDTree

from experiments.baselines.pointr import (
    POINTR_SMALL,
    Attention,
    Block,
    EdgeConv,
    GeometryAwareAttention,
    NormMLP,
    PoinTr,
    PoinTrConfig,
    proxy_indices,
)
from prism_jax.losses.primary import primary_loss

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


def num_parameters(tree):
    return sum(leaf.size for leaf in jax.tree.leaves(tree["params"]))


PARTIAL = normal(3, 64, 3)
COMPLETE = normal(3, 96, 3)
FARTHEST = np.array([[cloud[i] for i in farthest(cloud, 16)] for cloud in PARTIAL])
VARIABLES = jax.tree.map(
    lambda leaf: normal(
        *leaf.shape, scale=(leaf.shape[0] if leaf.ndim > 1 else 100) ** -0.5
    ),
    shapes(PoinTr(TINY), PARTIAL),
)


@pytest.fixture(scope="module")
def step(quick_jit):
    """Adam on the parameters as one vector, and where it starts: ``(vector, state,
    partials) -> (stages, loss, gradient, vector, state)``. Compiled once for all."""
    vector, unravel = ravel_pytree(VARIABLES)
    optimizer = optax.adam(1e-2)

    def loss(variables, partials):
        stages = PoinTr(TINY).apply(variables, partials)
        return jax.vmap(primary_loss)(stages, COMPLETE).mean(), stages

    def step(vector, state, partials):
        value_and_grad = jax.value_and_grad(loss, has_aux=True)
        (value, stages), gradient = value_and_grad(unravel(vector), partials)
        updates, state = optimizer.update(ravel_pytree(gradient)[0], state)
        return stages, value, gradient, vector + updates, state

    return quick_jit(step), (vector, optimizer.init(vector))


@pytest.fixture(scope="module")
def complete_fn(step):
    """``(variables, partials) -> stages``."""
    fn, (_, state) = step
    return lambda variables, partials: fn(ravel_pytree(variables)[0], state, partials)[
        0
    ]


@pytest.mark.parametrize(
    ("config", "sizes", "parameters"),
    [
        # The authors' release has the neighbour branch in all 6 and 8 blocks, one in an
        # encoder's and two in a decoder's, and runs that of the first of each.
        (
            PoinTrConfig(),
            (448, 16_384),
            42_498_054 - (5 + 2 * 7) * 2 * (2 * 384 + 1) * 384,
        ),
        (POINTR_SMALL, (192, 2048), 980_342),
    ],
)
def test_sizes_and_parameters(config, sizes, parameters):
    partial = jax.ShapeDtypeStruct((2, config.num_points, 3), jnp.float32)
    module = PoinTr(config)
    made = jax.eval_shape(
        lambda p: module.init_with_output(jax.random.key(0), p), partial
    )
    stages, variables = made
    assert tuple(stage.shape for stage in stages) == tuple((2, n, 3) for n in sizes)
    assert config.stage_sizes == sizes and config.num_outputs == sizes[-1]
    assert num_parameters(variables) == parameters
    assert ("batch_stats" in variables) == config.use_norm


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


def test_derivatives_of_a_block(x64):
    """Attentions and edge convolutions, among the tokens and to the encoder's."""
    x, encoded = normal(4, 6), normal(5, 6)
    neighbors, around = integers(4, 4, 3), integers(5, 4, 3)
    module = Block(2, 2)
    variables = randomised(module, x, neighbors, encoded, around)
    fn = jax.jit(lambda v: module.apply(v, x, neighbors, encoded, around))
    check_grads(fn, (variables,), order=1, modes=["rev"], rtol=1e-4)


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


def test_order_of_the_points_does_not_matter_after_the_first(complete_fn):
    order = np.concatenate([[0], 1 + RNG.permutation(63)])
    coarse, dense = complete_fn(VARIABLES, PARTIAL)
    again, shuffled = complete_fn(VARIABLES, PARTIAL[:, order])
    np.testing.assert_allclose(again, coarse, atol=1e-5)
    np.testing.assert_allclose(shuffled[:, :32], dense[:, :32], atol=1e-5)
    np.testing.assert_array_equal(shuffled[:, 32:], dense[:, 32:][:, order])
    moved, _ = complete_fn(VARIABLES, PARTIAL + 0.1)
    assert np.abs(moved - coarse)[:, :8].max() > 1e-3


@pytest.mark.slow
def test_batch_vmap_and_loop_agree(complete_fn, quick_jit):
    batch = complete_fn(VARIABLES, PARTIAL)
    mapped = quick_jit(jax.vmap(PoinTr(TINY).apply, (None, 0)))(VARIABLES, PARTIAL)
    # Each cloud in a batch of itself, so that nothing is compiled again.
    loop = [complete_fn(VARIABLES, jnp.stack([cloud] * 3)) for cloud in PARTIAL]
    for i, stage in enumerate(batch):
        np.testing.assert_allclose(stage, mapped[i], atol=1e-5)
        alone = np.stack([stages[i][0] for stages in loop])
        np.testing.assert_allclose(stage, alone, atol=1e-5)


def test_gradients_reach_every_parameter(step):
    fn, start = step
    gradient = fn(*start, PARTIAL)[2]
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0, path


def test_degenerate_clouds_stay_finite(step):
    fn, start = step
    line = PARTIAL[0, :, :1] * jnp.array([1.0, 2.0, -1.0])
    identical = jnp.broadcast_to(PARTIAL[0, :1], (64, 3))
    clouds = jnp.stack([identical, line, PARTIAL[0] + 1000.0])
    _, value, gradient, _, _ = fn(*start, clouds)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_a_few_steps_lower_the_loss(step):
    fn, (vector, state) = step
    losses = []
    for _ in range(10):
        _, value, _, vector, state = fn(vector, state, PARTIAL)
        losses.append(float(value))
    assert losses[-1] < 0.9 * losses[0]


@pytest.mark.slow
def test_training_moves_the_statistics_of_batch_norm(quick_jit):
    module = PoinTr(dataclasses.replace(TINY, use_norm=True))
    variables = randomised(module, PARTIAL)
    zeros = jax.tree.map(jnp.zeros_like, variables["batch_stats"])
    train = quick_jit(
        lambda params: module.apply(
            {"params": params, "batch_stats": zeros},
            PARTIAL,
            train=True,
            mutable=["batch_stats"],
        )
    )
    (_, dense), updated = train(variables["params"])
    assert dense.shape == (3, 96, 3) and np.isfinite(dense).all()
    found = updated["batch_stats"]
    assert all(np.abs(leaf).min() > 0 for leaf in jax.tree.leaves(found))
    layer = jax.tree.map(np.asarray, variables["params"]["position"]["dense_0"])
    hidden = FARTHEST.reshape(-1, 3) @ layer["kernel"] + layer["bias"]
    statistics = found["position"]["norm_0"]
    np.testing.assert_allclose(statistics["mean"], 0.1 * hidden.mean(0), atol=1e-5)
    np.testing.assert_allclose(statistics["var"], 0.1 * hidden.var(0), rtol=1e-4)


def test_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match="64 points"):
        PoinTr(TINY).apply(VARIABLES, PARTIAL[:, :63])
    with pytest.raises(ValueError, match="centers"):
        dataclasses.replace(TINY, num_queries=33)
