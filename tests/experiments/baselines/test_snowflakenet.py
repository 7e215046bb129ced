"""SnowflakeNet: its skip-transformer against a loop, and what is known of the whole."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax.traverse_util import flatten_dict
from jax.test_util import check_grads
from scipy.spatial import KDTree

from experiments.baselines.snowflakenet import (
    SNOWFLAKENET_SMALL,
    SkipTransformer,
    SnowflakeNet,
    SnowflakeNetConfig,
    partial_matching,
)
from prism_jax.losses.primary import primary_loss
from prism_jax.models.variables import apply_training

RNG = np.random.default_rng(0)
TINY = SnowflakeNetConfig(
    num_points=40,
    patch_points=(16, 8),
    patch_features=((6, 8), (8, 12)),
    global_features=(8, 8),
    patch_neighbors=4,
    num_neighbors=3,
    features=16,
    attention_features=4,
    attention_ratio=2,
    num_initial=20,
    up_factors=(1, 2),
    use_norm=False,
    num_seeds=12,
    seed_features=6,
)
NORMED = dataclasses.replace(TINY, use_norm=True)
MODEL = SnowflakeNet(TINY)


def normal(*shape):
    """Single precision, or double in the tests of gradients."""
    return jnp.asarray(RNG.normal(size=shape), jnp.result_type(float))


def drawn(module, *inputs, scale=1.0):
    """Variables of the module, biases and statistics included, drawn anew."""
    tree = jax.eval_shape(lambda: module.init(jax.random.key(0), *inputs))

    def draw(path, leaf):
        values = scale * RNG.normal(size=leaf.shape) / leaf.shape[0] ** 0.5
        values = abs(values) + 0.1 if path[-1].key == "var" else values
        return jnp.asarray(values, leaf.dtype)

    return jax.tree_util.tree_map_with_path(draw, tree)


@pytest.fixture(scope="module")
def variables():
    """Small enough for no attention to be of one neighbour alone."""
    return drawn(MODEL, normal(40, 3), scale=0.6)


@pytest.fixture(scope="module")
def clouds():
    complete = normal(3, TINY.num_outputs, 3) * np.float32(0.4)
    return complete[:, :40], complete


@pytest.fixture(scope="module")
def apply(quick_jit):
    return quick_jit(MODEL.apply)


@pytest.fixture(scope="module")
def step(quick_jit):
    """A step of Adam on all losses: ``(params, state, partial, complete) -> (loss,
    stages, matching, gradient, params, state)``. Compiled once for all."""
    optimiser = optax.adam(1e-2)

    def loss(params, partial, complete):
        given = ({"params": params}, partial, complete, "l1")
        stages, own = MODEL.apply(*given, method="supervised")
        primary = jax.vmap(lambda s, c: primary_loss(s, c, "l1"))(stages, complete)
        return (primary + own[:, 0]).mean(), (stages, own)

    def step(params, state, partial, complete):
        (value, made), gradient = jax.value_and_grad(loss, has_aux=True)(
            params, partial, complete
        )
        updates, state = optimiser.update(gradient, state)
        params = optax.apply_updates(params, updates)
        return value, *made, gradient, params, state

    return quick_jit(step), quick_jit(optimiser.init)


def published_layers():
    """Weights and biases of the release's layers, from its sizes for PCN."""
    dense = lambda i, o: i * o + o  # noqa: E731
    mlp_res = lambda i, h, o: dense(i, h) + dense(h, o) + dense(i, o)  # noqa: E731
    attention = (
        3 * dense(128, 64) + dense(3, 64) + dense(64, 64) + 2 * 64
    )  # keys, queries, values; positions with their norm
    attention += dense(64, 256) + dense(256, 64) + 2 * 256
    inside = attention - 3 * dense(128, 64) + 3 * dense(64, 64)
    yield from (dense(6, 64), dense(64, 128), dense(131, 128), dense(128, 256))
    yield from (inside + dense(c, 64) + dense(64, c) for c in (128, 256))
    yield from (dense(259, 512), dense(512, 512))
    yield 512 * 256 * 128 + 128
    yield from (mlp_res(640, 128, 128), mlp_res(128, 64, 128), mlp_res(640, 128, 128))
    yield from (dense(128, 64), dense(64, 3))
    for times in (1, 4, 8):
        yield from (dense(3, 64), dense(64, 128), dense(768, 256), dense(256, 128))
        yield mlp_res(256, 128, 128) + attention + dense(64, 128)
        yield from (dense(128, 64), dense(64, 32), 32 * 128 * times)
        yield from (mlp_res(256, 128, 128), dense(128, 64), dense(64, 3))


@pytest.mark.parametrize(
    ("config", "sizes", "parameters"),
    [
        (SnowflakeNetConfig(), (256, 512, 2048, 16384), sum(published_layers())),
        (SNOWFLAKENET_SMALL, (128, 256, 512, 2048), 1_129_484),
    ],
    ids=["published", "small"],
)
def test_stages_and_parameters(config, sizes, parameters):
    partial = jnp.zeros((2, config.num_points, 3))
    network = SnowflakeNet(config)
    stages, variables = jax.eval_shape(
        lambda: network.init_with_output(jax.random.key(0), partial)
    )
    assert [stage.shape for stage in stages] == [(2, size, 3) for size in sizes]
    assert config.num_outputs == sizes[-1]
    leaves = jax.tree.leaves(variables["params"])
    assert sum(leaf.size for leaf in leaves) == parameters
    assert ("batch_stats" in variables) == config.use_norm


def dense(params, x):
    return x @ params["kernel"] + params["bias"]


def norm_relu(params, x):
    x = (x - params["mean"]) / np.sqrt(params["var"] + 1e-5)
    return np.maximum(x * params["scale"] + params["bias"], 0)


def transformer_inputs():
    neighbors = jnp.asarray(RNG.integers(0, 7, (7, 3)))
    return normal(7, 3), normal(7, 16), normal(7, 16), neighbors


def test_skip_transformer_agrees_with_a_loop(quick_jit):
    """One point and one neighbour at a time, in double precision."""
    module, inputs = SkipTransformer(NORMED), transformer_inputs()
    variables = drawn(module, *inputs)
    made = quick_jit(module.apply)(variables, *inputs)

    params = jax.tree.map(np.float64, dict(variables["params"]))
    for name, stats in jax.tree.map(np.float64, variables["batch_stats"]).items():
        params[name] |= stats
    xyz, query, key = map(np.float64, inputs[:3])
    both, join = np.concatenate([key, query], -1), params["join"]
    joined = dense(join["dense_1"], np.maximum(dense(join["dense_0"], both), 0))
    joined += dense(join["shortcut"], both)
    for i, near in enumerate(np.asarray(inputs[3])):
        logits, values = [], []
        for j in near:
            offset = dense(params["position_0"], xyz[i] - xyz[j])
            offset = norm_relu(params["position_norm"], offset)
            offset = dense(params["position_1"], offset)
            pair = dense(params["query"], query[i]) - dense(params["key"], key[j])
            hidden = norm_relu(
                params["norm"], dense(params["attention_0"], pair + offset)
            )
            logits.append(dense(params["attention_1"], hidden))
            values.append(dense(params["value"], joined[j]) + offset)
        weights = np.exp(logits) / np.exp(logits).sum(0)
        expected = dense(params["end"], (weights * values).sum(0)) + joined[i]
        np.testing.assert_allclose(made[i], expected, rtol=1e-4, atol=1e-4)


def test_gradient_of_the_skip_transformer(x64):
    module, (*floats, neighbors) = SkipTransformer(TINY), transformer_inputs()
    variables = drawn(module, *floats, neighbors)

    @jax.jit
    def total(variables, *floats):
        return jnp.sin(module.apply(variables, *floats, neighbors)).sum()

    check_grads(total, (variables, *floats), order=1, modes=["rev"])


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_partial_matching_looks_one_way(norm, quick_jit):
    fn = quick_jit(jax.value_and_grad(partial_matching, 1), static_argnums=2)
    partial, prediction = normal(9, 3), normal(30, 3)
    gaps = KDTree(prediction).query(partial)[0]
    expected = np.mean(gaps if norm == "l1" else gaps**2)
    found, slope = fn(partial, prediction, norm)
    assert float(found) == pytest.approx(expected, rel=1e-5)
    assert (np.abs(slope).max(-1) > 0).sum() == len(
        {*KDTree(prediction).query(partial)[1]}
    )
    # Whatever else is predicted costs nothing, nor do points where they were measured.
    found, slope = fn(partial, prediction.at[:21].add(100).at[21:].set(partial), norm)
    assert found < 4e-5 and np.isfinite(slope).all()


@pytest.mark.slow
def test_its_own_loss_is_that_of_the_last_stage(variables, step, apply, clouds):
    fn, init = step
    params = variables["params"]
    _, stages, own, *_ = fn(params, init(params), *clouds)
    for i, cloud in enumerate(clouds[0]):
        gaps = KDTree(stages[-1][i]).query(cloud)[0]
        assert float(own[i, 0]) == pytest.approx(gaps.mean(), rel=1e-4)
        for stage, alone in zip(stages, apply(variables, cloud), strict=True):
            np.testing.assert_allclose(stage[i], alone, rtol=1e-5, atol=1e-5)


def test_without_offsets_every_stage_is_made_of_seeds_and_partial(
    variables, apply, clouds
):
    partial = clouds[0][0]
    still = jax.tree_util.tree_map_with_path(
        lambda path, leaf: leaf * ("offset" not in jax.tree_util.keystr(path)),
        variables,
    )
    seeds, first, last = apply(still, partial)
    np.testing.assert_array_equal(last, np.repeat(first, 2, axis=0))
    known = np.concatenate([seeds, partial])
    assert (np.linalg.norm(known[:, None] - first, axis=-1).min(0) == 0).all()


def test_the_order_of_points_is_free_but_for_the_first(variables, apply, clouds):
    partial = clouds[0][0]
    order = np.concatenate([[0], 1 + RNG.permutation(39)])
    expected = apply(variables, partial)
    for stage, other in zip(expected, apply(variables, partial[order]), strict=True):
        np.testing.assert_allclose(other, stage, rtol=1e-5, atol=1e-5)
    moved = apply(variables, partial + 0.5)
    assert abs(moved[0] - expected[0]).max() > 1e-3


def test_displacements_of_one_layer_reach_the_next(variables, apply, clouds):
    """Where the points do not tell: they stay where they are in the first layer."""
    partial, still = clouds[0][0], jax.tree.map(lambda leaf: leaf, variables)
    first = still["params"]["deconvolution_0"]
    first["offset"] = jax.tree.map(np.zeros_like, first["offset"])
    expected = apply(still, partial)
    last = first["child"]["dense_1"]
    last["bias"] = last["bias"] + 1.0
    found = apply(still, partial)
    np.testing.assert_array_equal(found[1], expected[1])
    assert abs(found[2] - expected[2]).max() > 1e-4


def test_gradients_reach_every_leaf(variables, step, clouds):
    fn, init = step
    params = variables["params"]
    loss, _, _, gradient, _, _ = fn(params, init(params), *clouds)
    assert np.isfinite(loss)
    for name, leaf in flatten_dict(gradient, sep="/").items():
        assert np.isfinite(leaf).all(), name
        # A softmax does not see its logits' bias.
        unseen = name.endswith("attention_1/bias")
        assert abs(leaf).max() < 1e-6 if unseen else abs(leaf).max() > 0, name


@pytest.mark.parametrize("kind", ["one point", "origin", "collinear", "far"])
def test_degenerate_clouds_stay_finite(variables, step, clouds, kind):
    points = np.array(clouds[0])
    partial = {
        "one point": np.broadcast_to(points[:1, :1], points.shape),
        "origin": 0 * points,
        "collinear": points[..., :1] * np.float32([1, 2, -1]),
        "far": points + 100,
    }[kind]
    fn, init = step
    params = variables["params"]
    loss, _, _, gradient, _, _ = fn(params, init(params), partial, clouds[1])
    assert np.isfinite(loss)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_an_empty_cloud_is_refused(variables):
    with pytest.raises(ValueError, match="empty cloud"):
        jax.eval_shape(MODEL.apply, variables, jnp.zeros((0, 3)))


def test_a_few_steps_lower_the_loss(variables, step, clouds):
    fn, init = step
    params = variables["params"]
    state, losses = init(params), []
    for _ in range(8):
        loss, _, _, _, params, state = fn(params, state, *clouds)
        losses.append(float(loss))
    assert losses[-1] < 0.9 * losses[0]


def test_it_has_what_a_training_asks_for(variables, clouds):
    """As `network_phase` calls it."""
    (stages, losses), statistics = jax.eval_shape(
        lambda: apply_training(
            MODEL,
            variables,
            *clouds,
            "l1",
            method="supervised",
            rngs={"noise": jax.random.key(0)},
        )
    )
    assert statistics == {} and losses.shape == (3, len(MODEL.own_losses))
    assert [stage.shape[1] for stage in stages] == [12, 20, 40]


@pytest.mark.slow
def test_training_moves_the_statistics(quick_jit, clouds):
    network, partial = SnowflakeNet(NORMED), clouds[0]
    variables = drawn(network, partial)
    trained = quick_jit(
        lambda v, p: network.apply(v, p, train=True, mutable=["batch_stats"])
    )
    stages, updated = trained(variables, partial)
    assert all(np.isfinite(stage).all() for stage in stages)
    before = flatten_dict(variables["batch_stats"])
    after = flatten_dict(updated["batch_stats"])
    assert before.keys() == after.keys()
    for path, leaf in after.items():
        assert abs(leaf - before[path]).max() > 1e-6, path
