"""Attentions: what `test_crapcn_parity.py`, which has their values, does not ask."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from prism_jax.models.attention import (
    Cloud,
    CrossResolutionTransformer,
    VectorAttention,
    attend,
)
from prism_jax.models.config import BackboneConfig
from prism_jax.models.pyramid import build_pyramid
from tests.trees import drawn

RNG = np.random.default_rng(0)
WIDTH = 6
CONFIG = BackboneConfig(features=WIDTH, attention_features=4, attention_ratio=3)
TRANSFORMER = CrossResolutionTransformer(CONFIG)


def normal(*shape):
    """Single precision, or double in the tests of gradients."""
    return jnp.asarray(RNG.normal(size=shape), jnp.result_type(float))


def clouds():
    """Seven queries and nine supports with their features."""
    return [Cloud(normal(count, 3), normal(count, WIDTH)) for count in (7, 9)]


def test_without_norm_it_is_that_of_a_norm_that_does_nothing():
    """In a batch as one by one."""
    inputs = (*clouds(), jnp.asarray(RNG.integers(0, 9, (7, 4))))
    plain = VectorAttention(dataclasses.replace(CONFIG, use_norm=False))
    normed, variables = VectorAttention(CONFIG), drawn(plain, *inputs)
    identity = jax.jit(normed.init)(jax.random.key(0), *inputs)
    identity["params"] |= variables["params"]
    identity["batch_stats"] = jax.tree.map(
        lambda leaf: leaf * (1 - 1e-5), identity["batch_stats"]
    )
    expected = jax.jit(normed.apply)(identity, *inputs)
    batch = jax.tree.map(lambda array: jnp.stack([array, array[::-1]]), inputs)
    together, mapped = jax.jit(
        lambda *batch: (
            plain.apply(variables, *batch),
            jax.vmap(lambda *inputs: plain.apply(variables, *inputs))(*batch),
        )
    )(*batch)
    np.testing.assert_allclose(together[0], expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(together, mapped, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("x64")
def test_attend_is_a_softmax_over_the_neighbours():
    logits, values = normal(3, 4, 2), normal(3, 4, 2)
    expected = (jax.nn.softmax(30 * logits, -2) * values).sum(-2)
    compiled = jax.jit(attend)
    np.testing.assert_allclose(compiled(30 * logits, values), expected, rtol=1e-10)
    check_grads(compiled, (logits, values), order=2, modes=["rev"], eps=1e-6)
    gradient = jax.grad(lambda x: compiled(x, values).sum())(logits * 1e4)
    assert np.isfinite(gradient).all()


@jax.jit
def two_levels(query, support):
    orders = jnp.array([3, 0, 5, 6]), jnp.array([1, 4, 2, 7])
    return build_pyramid(query, support, *orders, (1, 2), (3, 2))


@jax.jit
def value_and_gradients(params, statistics, clouds, pyramid):
    def total(params, clouds):
        variables = {"params": params, "batch_stats": statistics}
        return jnp.sin(TRANSFORMER.apply(variables, *clouds, pyramid)).sum()

    return jax.value_and_grad(total, (0, 1))(params, clouds)


def transformed(*inputs):
    """Value and gradients with random weights; with a step, that far from there."""
    pyramid = two_levels(*(cloud.xyz for cloud in inputs))
    variables = drawn(TRANSFORMER, *inputs, pyramid)
    at, statistics = (variables["params"], inputs), variables["batch_stats"]

    def results(step=None):
        params, moved = at if step is None else jax.tree.map(np.add, at, step)
        return value_and_gradients(params, statistics, moved, pyramid)

    return results


@pytest.mark.parametrize("kind", ["coincident", "identical", "far"])
def test_degenerate_clouds_have_finite_gradients(kind):
    (query_xyz, query), (support_xyz, support) = clouds()
    query_xyz, support_xyz = {
        "coincident": (support_xyz[:7], support_xyz),
        "identical": (jnp.ones((7, 3)), jnp.ones((9, 3))),
        "far": (query_xyz + 1000, support_xyz + 1000),
    }[kind]
    results = transformed(Cloud(query_xyz, query), Cloud(support_xyz, support))()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(results))


@pytest.mark.usefixtures("x64")
def test_gradients_of_the_transformer():
    """Along a random direction of weights and clouds, by differences."""
    results = transformed(*clouds())
    _, gradients = results()
    step = jax.tree.map(lambda leaf: 1e-6 * RNG.normal(size=leaf.shape), gradients)
    ahead, behind = results(step)[0], results(jax.tree.map(np.negative, step))[0]
    expected = 2 * sum(jax.tree.leaves(jax.tree.map(np.vdot, gradients, step)))
    np.testing.assert_allclose(ahead - behind, expected, rtol=1e-5)
