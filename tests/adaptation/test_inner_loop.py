"""Unrolled gradient steps against their closed form on a quadratic."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.inner_loop import descend, step_sizes, unroll
from prism_jax.models.variables import pop_encoders
from tests.trees import equal

RNG = np.random.default_rng(0)
SIZE, STEPS = 5, 3
_ROOT = RNG.normal(size=(SIZE, SIZE))
HESSIAN = _ROOT @ _ROOT.T / SIZE + np.eye(SIZE)
TARGET, START = RNG.normal(size=SIZE), RNG.normal(size=(2, SIZE))
CURVATURE = np.diag([3.0, 1.0, 4.0, 1.0, 5.0])
# Each group has a step size: x_k - target = (I - diag(a) H)^k (x_0 - target).
SIZES = {"a": 0.1, "b": 0.3}
GROUPS = {"a": np.array([1.0, 1, 0, 0, 0]), "b": np.array([0, 0, 1.0, 1, 1])}


def quadratic(x, target=TARGET):
    away = x - target
    return 0.5 * away @ jnp.asarray(HESSIAN) @ away, x


def grouped(x):
    """A tree that is deeper than that of the step sizes."""
    return {"a": x[:2], "b": {"c": x[2:4], "d": x[4:]}}


def flat(tree):
    return jnp.concatenate(jax.tree.leaves(tree))


SHRINK = np.eye(SIZE) - np.diag(sum(SIZES[name] * GROUPS[name] for name in SIZES))
SHRINK = np.eye(SIZE) - (np.eye(SIZE) - SHRINK) @ HESSIAN
POWER = [np.linalg.matrix_power(SHRINK, k) for k in range(STEPS + 1)]


@pytest.fixture(scope="module")
def meta_gradients():
    """Of a second quadratic of where the steps on the first one lead, from two starts:
    value, losses and extras, and gradients in start, step sizes and target."""

    def meta_loss(start, sizes, target):
        def loss(tree):
            return quadratic(flat(tree), target)

        adapted, seen = unroll(loss, grouped(start), sizes, STEPS)
        x = flat(adapted)
        return 0.5 * x @ jnp.asarray(CURVATURE) @ x, seen

    gradient = jax.value_and_grad(meta_loss, argnums=(0, 1, 2), has_aux=True)
    over = jax.jit(jax.vmap(gradient, (0, None, None)))
    with jax.enable_x64(True):
        sizes = jax.tree.map(jnp.array, SIZES)
        return jax.device_get(over(jnp.array(START), sizes, jnp.array(TARGET)))


@pytest.mark.parametrize("i", range(len(START)))
def test_values_and_meta_gradients_are_the_closed_form(meta_gradients, i):
    """Losses and extras are those before a step."""
    (value, (losses, seen)), (by_start, by_sizes, by_target) = jax.tree.map(
        lambda leaf: leaf[i], meta_gradients
    )
    away = START[i] - TARGET
    *before, x = [TARGET + power @ away for power in POWER]
    outer = CURVATURE @ x
    np.testing.assert_allclose(value, 0.5 * x @ outer, rtol=1e-12)
    np.testing.assert_allclose(seen, before, rtol=1e-12)
    expected = [0.5 * (y - TARGET) @ HESSIAN @ (y - TARGET) for y in before]
    np.testing.assert_allclose(losses, expected, rtol=1e-12)
    np.testing.assert_allclose(by_start, POWER[STEPS].T @ outer, rtol=1e-11)
    expected = (np.eye(SIZE) - POWER[STEPS]).T @ outer
    np.testing.assert_allclose(by_target, expected, rtol=1e-11)
    for name, group in GROUPS.items():
        inner = -np.diag(group) @ HESSIAN
        turned = sum(POWER[STEPS - 1 - k] @ inner @ POWER[k] for k in range(STEPS))
        expected = outer @ turned @ away
        np.testing.assert_allclose(by_sizes[name], expected, rtol=1e-11)


def test_a_gradient_above_the_bound_is_scaled_down_to_it(x64):
    """By its global norm, before the step sizes; one below it is as it was."""
    grads = {"a": jnp.array([3.0, 0.0]), "b": {"c": jnp.array(-4.0)}}
    params = jax.tree.map(jnp.zeros_like, grads)
    moved = descend(params, grads, {"a": 0.5, "b": 2.0}, clip_norm=0.1)
    np.testing.assert_allclose(moved["a"], [-0.5 * 0.06, 0], rtol=1e-12)
    np.testing.assert_allclose(moved["b"]["c"], 2.0 * 0.08, rtol=1e-12)
    below = descend(params, grads, 0.5, clip_norm=5.0)
    assert equal(below, descend(params, grads, 0.5))


def test_a_gradient_of_zero_can_be_bounded(x64):
    """At the minimum: no step, and the derivative of a gradient that is not bounded."""
    step = jax.jit(lambda x: unroll(quadratic, x, 0.1, 1, clip_norm=0.5)[0])
    jacobian = jax.jacrev(step)(jnp.array(TARGET))
    np.testing.assert_allclose(jacobian, np.eye(SIZE) - 0.1 * HESSIAN, rtol=1e-12)


@pytest.mark.parametrize("adapt_norm", [True, False])
def test_step_sizes_are_what_was_learned_times_the_configurations(
    minimal, minimal_variables, adapt_norm
):
    """One for each module of the encoders, all of them different here; if norms are
    held, none for those that have statistics."""
    config = dataclasses.replace(minimal.adapt, step_size=0.25, adapt_norm=adapt_norm)
    encoders, _ = pop_encoders(minimal_variables)
    learned = minimal_variables["weighting"]["log_steps"]
    assert len({float(leaf) for leaf in jax.tree.leaves(learned)}) > 10
    start = jax.tree.map(np.zeros_like, encoders)
    ones = jax.tree.map(np.ones_like, encoders)
    moved = descend(start, ones, step_sizes(minimal_variables, config))
    statistics = jax.tree_util.tree_leaves_with_path(minimal_variables["batch_stats"])
    norms = {jax.tree_util.keystr(path[:-1]) for path, _ in statistics}
    held = 0
    for path, leaf in jax.tree_util.tree_leaves_with_path(moved):
        encoder, module = path[0].key, path[1].key
        expected = -0.25 * np.exp(np.float64(learned[encoder][module]))
        if not adapt_norm and jax.tree_util.keystr(path[:-1]) in norms:
            expected, held = 0.0, held + 1
        np.testing.assert_allclose(leaf, np.full(leaf.shape, expected), rtol=1e-6)
    assert (held > 10) != adapt_norm
