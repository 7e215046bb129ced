"""SnowflakeNet: its skip-transformer against a loop, and what is known of the whole."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial import KDTree

from experiments.baselines.snowflakenet import (
    SkipTransformer,
    SnowflakeNet,
    SnowflakeNetConfig,
    partial_matching,
)
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


def test_published_number_of_parameters():
    """`test_networks` counts them."""
    assert sum(published_layers()) == 19_317_612


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
def test_its_own_loss_is_that_of_the_last_stage(variables, apply, clouds, quick_jit):
    fn = quick_jit(lambda v, *both: MODEL.apply(v, *both, "l1", method="supervised"))
    stages, own = fn(variables, *clouds)
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
