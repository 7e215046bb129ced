"""Attentions against loops in NumPy, one point and one neighbour at a time."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from prism_jax.models.attention import (
    CrossResolutionTransformer,
    UpsamplingAttention,
    VectorAttention,
    attend,
)
from prism_jax.models.config import BackboneConfig
from prism_jax.models.pyramid import build_pyramid

RNG = np.random.default_rng(0)
WIDTH, INNER, RATIO = 6, 4, 3


def normal(*shape):
    """Single precision, or double in the tests of gradients."""
    return jnp.asarray(RNG.normal(size=shape), jnp.result_type(float))


def randomised(module, *inputs):
    """Variables of the module, biases and statistics included, drawn anew."""
    tree = jax.eval_shape(lambda: module.init(jax.random.key(0), *inputs))

    def draw(path, leaf):
        values = normal(*leaf.shape) / np.sqrt(leaf.shape[0])
        return abs(values) + 0.1 if path[-1].key == "var" else values

    return jax.tree_util.tree_map_with_path(draw, tree)


def as_numpy(variables):
    """Parameters as float64, with the statistics beside them."""
    params = jax.tree.map(np.float64, dict(variables["params"]))
    for name, stats in jax.tree.map(np.float64, variables["batch_stats"]).items():
        params[name] |= stats
    return params


def dense(params, x):
    return x @ params["kernel"] + params["bias"]


def norm_relu(params, x):
    x = (x - params["mean"]) / np.sqrt(params["var"] + 1e-5)
    return np.maximum(x * params["scale"] + params["bias"], 0)


def pair(params, query_xyz, query, support_xyz, support):
    """Hidden logits and value of one query and one of its neighbours."""
    offset = dense(params["position_0"], query_xyz - support_xyz)
    offset = dense(params["position_1"], norm_relu(params["position_norm"], offset))
    difference = dense(params["query"], query) - dense(params["key"], support)
    hidden = dense(params["attention_0"], difference + offset)
    return norm_relu(params["norm"], hidden), dense(params["value"], support) + offset


def looped_attention(params, query_xyz, query, support_xyz, support, neighbors):
    query_xyz, query, support_xyz, support = map(
        np.float64, (query_xyz, query, support_xyz, support)
    )
    rows = []
    for xyz, feature, near in zip(query_xyz, query, neighbors, strict=True):
        pairs = [pair(params, xyz, feature, support_xyz[j], support[j]) for j in near]
        logits = np.stack([dense(params["attention_1"], hidden) for hidden, _ in pairs])
        weights = np.exp(logits - logits.max(0))
        weights /= weights.sum(0)
        attended = (weights * np.stack([value for _, value in pairs])).sum(0)
        rows.append(dense(params["end"], attended) + feature)
    return np.stack(rows)


def clouds(num_queries=7, num_supports=9, k=4):
    neighbors = jnp.asarray(RNG.integers(0, num_supports, (num_queries, k)))
    query = normal(num_queries, 3), normal(num_queries, WIDTH)
    return (*query, normal(num_supports, 3), normal(num_supports, WIDTH), neighbors)


CONFIG = BackboneConfig(
    features=WIDTH, attention_features=INNER, attention_ratio=RATIO, use_norm=True
)
ATTENTION = VectorAttention(CONFIG)
TRANSFORMER = CrossResolutionTransformer(CONFIG)
attention = jax.jit(ATTENTION.apply)
transformer = jax.jit(TRANSFORMER.apply)


def test_vector_attention_agrees_with_a_loop():
    inputs = clouds()
    variables = randomised(ATTENTION, *inputs)
    expected = looped_attention(as_numpy(variables), *inputs)
    actual = attention(variables, *inputs)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)

    batch = [jnp.stack([a, b]) for a, b in zip(inputs, clouds(), strict=True)]
    together = attention(variables, *batch)
    mapped = jax.vmap(lambda *inputs: attention(variables, *inputs))(*batch)
    np.testing.assert_allclose(together[0], expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(together, mapped, rtol=1e-4, atol=1e-5)


def test_vector_attention_without_norm():
    module, inputs = VectorAttention(replace(CONFIG, use_norm=False)), clouds()
    variables = randomised(module, *inputs)
    assert set(variables) == {"params"}
    identity = {"scale": 1.0, "bias": 0.0, "mean": 0.0, "var": 1.0 - 1e-5}
    params = jax.tree.map(np.float64, dict(variables["params"]))
    params |= {"norm": identity, "position_norm": identity}
    expected = looped_attention(params, *inputs)
    actual = jax.jit(module.apply)(variables, *inputs)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)


def test_training_changes_the_statistics_alone():
    inputs = clouds()
    variables = randomised(ATTENTION, *inputs)
    training = partial(ATTENTION.apply, train=True, mutable=["batch_stats"])
    _, updated = jax.jit(training)(variables, *inputs)
    old, new = variables["batch_stats"], updated["batch_stats"]
    assert jax.tree.structure(old) == jax.tree.structure(new)
    assert not any(jax.tree.leaves(jax.tree.map(np.array_equal, old, new)))


@pytest.mark.parametrize("times", [1, 3])
def test_upsampling_attention_agrees_with_a_loop(times):
    xyz, features = normal(5, 3), normal(5, WIDTH)
    neighbors = jnp.asarray(RNG.integers(0, 5, (5, 4)))
    module = UpsamplingAttention(replace(CONFIG, features=8, seed_times=times))
    variables = randomised(module, xyz, features, neighbors)
    params, xyz_, features_ = as_numpy(variables), np.float64(xyz), np.float64(features)
    kernel, bias = (
        params["attention_1"]["dense"]["kernel"],
        params["attention_1"]["bias"],
    )
    expected = []
    for i in range(5):
        pairs = [
            pair(params, xyz_[i], features_[i], xyz_[j], features_[j])
            for j in np.asarray(neighbors[i])
        ]
        for child in range(times):
            # No softmax here.
            attended = sum((h @ kernel[:, child] + bias) * v for h, v in pairs)
            residual = dense(params["residual"], features_[i])
            expected.append(dense(params["end"], attended) + residual)
    actual = jax.jit(module.apply)(variables, xyz, features, neighbors)
    assert actual.shape == (5 * times, 8)
    np.testing.assert_allclose(actual, np.stack(expected), rtol=1e-4, atol=1e-5)


def test_attend_is_a_softmax_over_the_neighbours():
    logits, values = 30 * normal(2, 5, 4, 3), normal(2, 5, 4, 3)
    expected = (jax.nn.softmax(logits, -2) * values).sum(-2)
    np.testing.assert_allclose(attend(logits, values), expected, rtol=1e-5, atol=1e-6)
    mapped = jax.vmap(attend)(logits, values)
    np.testing.assert_allclose(mapped, expected, rtol=1e-5, atol=1e-6)
    one = attend(logits[..., :1, :], values[..., :1, :])
    np.testing.assert_array_equal(one, values[..., 0, :])


@pytest.mark.usefixtures("x64")
def test_derivatives_of_attend():
    inputs = normal(3, 4, 2), normal(3, 4, 2)
    check_grads(jax.jit(attend), inputs, order=2, modes=["fwd", "rev"], eps=1e-6)
    huge = inputs[0] * 1e4
    gradient = jax.grad(lambda x: attend(x, inputs[1]).sum())(huge)
    assert np.isfinite(gradient).all()


@partial(jax.jit, static_argnames="k")
def two_levels(query, support, k=3):
    every = [np.arange(len(cloud)) for cloud in (query, support)]
    coarse = [np.array([3, 0, 5, 6]), np.array([1, 4, 2])]
    rows = (
        (jnp.asarray(a), jnp.asarray(b)) for a, b in zip(every, coarse, strict=True)
    )
    return build_pyramid(jnp.asarray(query), jnp.asarray(support), *rows, (k, 2))


def looped_interpolation(query, support, features):
    rows = []
    for point in query:
        squared = ((point - support) ** 2).sum(-1)
        nearest = np.argsort(squared)[:3]
        weights = 1 / (squared[nearest] + 1e-8)
        rows.append((weights[:, None] * features[nearest]).sum(0) / weights.sum())
    return np.stack(rows)


def looped_residual(params, x):
    hidden = np.maximum(dense(params["dense_0"], x), 0)
    return dense(params["dense_1"], hidden) + dense(params["shortcut"], x)


def test_transformer_agrees_with_a_loop():
    inputs = clouds()[:4]
    pyramid = two_levels(inputs[0], inputs[2])
    variables = randomised(TRANSFORMER, *inputs, pyramid)
    params = jax.tree.map(np.float64, variables["params"])
    for name, stats in variables["batch_stats"].items():
        params[name] = as_numpy(
            {"params": variables["params"][name], "batch_stats": stats}
        )
    query_xyz, query, support_xyz, support = map(np.float64, inputs)
    fine, coarse = (jax.tree.map(np.asarray, level) for level in pyramid)
    coarse_xyz, coarse_support = query_xyz[coarse.query_rows], coarse.support_rows
    lower = looped_attention(
        params["attention_1"],
        *(coarse_xyz, query[coarse.query_rows]),
        *(support_xyz[coarse_support], support[coarse_support]),
        coarse.neighbors,
    )

    def joined(name, xyz, features):
        raised = looped_interpolation(xyz, coarse_xyz, lower)
        return looped_residual(params[name], np.concatenate([features, raised], -1))

    query = joined("query_0", query_xyz, query)
    support = joined("support_0", support_xyz, support)
    expected = looped_attention(
        params["attention_0"], query_xyz, query, support_xyz, support, fine.neighbors
    )
    actual = transformer(variables, *inputs, pyramid)
    np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-4)


@jax.jit
def value_and_gradients(variables, *inputs):
    def total(variables, *inputs):
        return TRANSFORMER.apply(variables, *inputs).sum()

    return jax.value_and_grad(total, (0, 1, 2, 3, 4))(variables, *inputs)


@pytest.mark.parametrize("kind", ["coincident", "identical", "far"])
def test_degenerate_clouds_have_finite_gradients(kind):
    query_xyz, query, support_xyz, support, _ = clouds()
    if kind == "coincident":
        query_xyz = support_xyz[:7]
    if kind == "identical":
        query_xyz, support_xyz = jnp.ones((7, 3)), jnp.ones((9, 3))
    if kind == "far":
        query_xyz, support_xyz = query_xyz + 1000, support_xyz + 1000
    pyramid = two_levels(query_xyz, support_xyz)
    inputs = query_xyz, query, support_xyz, support
    variables = randomised(TRANSFORMER, *inputs, pyramid)

    value, gradients = value_and_gradients(variables, *inputs, pyramid)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


@pytest.mark.usefixtures("x64")
def test_gradients_of_the_transformer():
    inputs = clouds()[:4]
    pyramid = two_levels(inputs[0], inputs[2])
    variables = randomised(TRANSFORMER, *inputs, pyramid)

    @jax.jit
    def total(params, *inputs):
        tree = variables | {"params": params}
        return jnp.sin(TRANSFORMER.apply(tree, *inputs, pyramid)).sum()

    check_grads(total, (variables["params"], *inputs), order=1, modes=["rev"], eps=1e-6)
