"""Unrolled gradient steps against their closed form on a quadratic."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.inner_loop import descend, step_sizes, unroll
from prism_jax.models.variables import pop_encoders

RNG = np.random.default_rng(0)
SIZE = 5
_ROOT = RNG.normal(size=(SIZE, SIZE))
HESSIAN = _ROOT @ _ROOT.T / SIZE + np.eye(SIZE)
TARGET, START = RNG.normal(size=SIZE), RNG.normal(size=SIZE)
STEP_SIZE = 0.1


def quadratic(x, target=TARGET):
    away = x - target
    return 0.5 * away @ jnp.asarray(HESSIAN) @ away, x


def test_the_body_is_traced_once_for_any_number_of_steps():
    def traces(num_steps):
        count = 0

        def counted(x):
            nonlocal count
            count += 1
            return quadratic(x)

        start = jnp.asarray(START, jnp.float32)
        jax.jit(lambda x: unroll(counted, x, STEP_SIZE, num_steps)).lower(start)
        return count

    assert traces(1) == traces(100) == 1


def test_a_loss_that_is_not_finite_stays_visible():
    start = jnp.array([-1.0])
    _, (losses, _) = unroll(lambda x: (jnp.log(x).sum(), None), start, 0.1, 2)
    assert np.isnan(losses).all()


# A step size of its own for two groups of coordinates: x_k - target = M^k (x_0 -
# target) with M = I - diag(a) H.
SIZES = {"a": 0.1, "b": 0.3}
GROUPS = {"a": np.array([1.0, 1, 0, 0, 0]), "b": np.array([0, 0, 1.0, 1, 1])}
CURVATURE = np.diag([3.0, 1.0, 4.0, 1.0, 5.0])
STEPS = 3


def grouped(x):
    """A tree that is deeper than that of the step sizes."""
    return {"a": x[:2], "b": {"c": x[2:4], "d": x[4:]}}


def flat(tree):
    return jnp.concatenate(jax.tree.leaves(tree))


def meta_loss(start, sizes, target, first_order=False):
    """A second quadratic of where the steps on the first one lead."""
    adapted, _ = unroll(
        lambda tree: quadratic(flat(tree), target),
        grouped(start),
        sizes,
        STEPS,
        first_order,
    )
    x = flat(adapted)
    return 0.5 * x @ jnp.asarray(CURVATURE) @ x


def shrink_by(sizes):
    rates = sum(sizes[name] * GROUPS[name] for name in GROUPS)
    return np.eye(SIZE) - np.diag(rates) @ HESSIAN


@pytest.fixture(scope="module")
def meta_gradients():
    """Value, and gradients in start, step sizes and target: second and first order."""
    with jax.enable_x64(True):
        arguments = jnp.array(START), jax.tree.map(jnp.array, SIZES), jnp.array(TARGET)
        gradient = jax.value_and_grad(meta_loss, argnums=(0, 1, 2))
        orders = [gradient(*arguments, order) for order in (False, True)]
        return jax.device_get(orders)


def test_parameters_losses_and_extras(x64):
    """x_k - target = M^k (x_0 - target); losses and extras are those before a step."""

    def loss(tree):
        return quadratic(flat(tree))

    for num_steps in (0, 4):
        adapted, (losses, seen) = unroll(loss, grouped(START), SIZES, num_steps)
        assert jax.tree.structure(adapted) == jax.tree.structure(grouped(START))
        power = [
            np.linalg.matrix_power(shrink_by(SIZES), k) for k in range(num_steps + 1)
        ]
        *before, end = (TARGET + each @ (START - TARGET) for each in power)
        np.testing.assert_allclose(flat(adapted), end, rtol=1e-12)
        expected = [float(quadratic(x)[0]) for x in before]
        np.testing.assert_allclose(losses, expected, rtol=1e-12)
        assert losses.shape == (num_steps,)
        np.testing.assert_allclose(seen, np.reshape(before, (-1, SIZE)), rtol=1e-12)


def test_meta_gradient_is_the_closed_form(meta_gradients):
    value, (by_start, by_sizes, by_target) = meta_gradients[0]
    shrink = shrink_by(SIZES)
    power = [np.linalg.matrix_power(shrink, k) for k in range(STEPS + 1)]
    away = START - TARGET
    x = TARGET + power[STEPS] @ away
    outer = CURVATURE @ x
    np.testing.assert_allclose(value, 0.5 * x @ outer, rtol=1e-12)
    np.testing.assert_allclose(by_start, power[STEPS].T @ outer, rtol=1e-11)
    expected = (np.eye(SIZE) - power[STEPS]).T @ outer
    np.testing.assert_allclose(by_target, expected, rtol=1e-11)
    assert set(by_sizes) == set(SIZES)
    for name, group in GROUPS.items():
        inner = -np.diag(group) @ HESSIAN
        turned = sum(power[STEPS - 1 - k] @ inner @ power[k] for k in range(STEPS))
        expected = outer @ turned @ away
        np.testing.assert_allclose(by_sizes[name], expected, rtol=1e-11)


def test_first_order_takes_the_inner_gradients_as_constants(meta_gradients):
    """x_K = x_0 - diag(a) sum g_k: nothing of the target is left to differentiate."""
    (second, exact), (first, (by_start, by_sizes, by_target)) = meta_gradients
    assert float(first) == float(second)
    shrink, away = shrink_by(SIZES), START - TARGET
    reached = [np.linalg.matrix_power(shrink, k) @ away for k in range(STEPS + 1)]
    outer = CURVATURE @ (TARGET + reached[STEPS])
    np.testing.assert_allclose(by_start, outer, rtol=1e-11)
    assert (np.asarray(by_target) == 0).all()
    descended = -HESSIAN @ sum(reached[:STEPS])
    for name, group in GROUPS.items():
        expected = outer @ (group * descended)
        np.testing.assert_allclose(by_sizes[name], expected, rtol=1e-11)
        assert abs(by_sizes[name] - exact[1][name]) > 0.05 * abs(exact[1][name])
    assert np.abs(by_start - exact[0]).max() > 0.1 * np.abs(exact[0]).max()


def test_a_step_size_holds_for_all_below_its_place():
    params = {"a": jnp.zeros(2), "b": {"c": jnp.zeros(()), "d": jnp.zeros((1, 3))}}
    for sizes, expected in (
        (0.5, [0.5, 0.5, 0.5]),
        ({"a": 0.5, "b": 0.25}, [0.5, 0.25, 0.25]),
        ({"a": 0.5, "b": {"c": 0.25, "d": 0.0}}, [0.5, 0.25, 0.0]),
    ):
        moved = descend(params, jax.tree.map(jnp.ones_like, params), sizes)
        assert jax.tree.structure(moved) == jax.tree.structure(params)
        for leaf, size in zip(jax.tree.leaves(moved), expected, strict=True):
            assert (np.asarray(leaf) == -size).all()
    for sizes in ({"a": 0.1}, {"a": 0.1, "c": 0.1}):
        with pytest.raises(ValueError, match="tree"):
            descend(params, params, sizes)


def test_a_gradient_above_the_bound_is_scaled_down_to_it(x64):
    """By its global norm, before the step sizes; one below it is as it was."""
    grads = {"a": jnp.array([3.0, 0.0]), "b": {"c": jnp.array(-4.0)}}
    params = jax.tree.map(jnp.zeros_like, grads)
    sizes = {"a": 0.5, "b": 2.0}
    moved = descend(params, grads, sizes, clip_norm=0.1)
    np.testing.assert_allclose(moved["a"], [-0.5 * 0.06, 0], rtol=1e-12)
    np.testing.assert_allclose(moved["b"]["c"], 2.0 * 0.08, rtol=1e-12)
    plain = descend(params, grads, sizes)
    for bound in (5.0, 6.0):
        below = descend(params, grads, sizes, clip_norm=bound)
        for a, b in zip(*map(jax.tree.leaves, (below, plain)), strict=True):
            assert np.array_equal(a, b)


def test_derivative_through_a_bounded_gradient(x64):
    """x_1 = x_0 - a c g / |g|: the derivative is I - a c (I - g g' / |g|^2) H / |g|."""
    bound = 0.3

    def adapted(x, first_order=False):
        moved, _ = unroll(quadratic, x, STEP_SIZE, 1, first_order, bound)
        return moved

    gradient = HESSIAN @ (START - TARGET)
    norm = np.linalg.norm(gradient)
    assert norm > 2 * bound
    start = jnp.array(START)
    expected = START - STEP_SIZE * bound * gradient / norm
    np.testing.assert_allclose(adapted(start), expected, rtol=1e-12)
    across = np.eye(SIZE) - np.outer(gradient, gradient) / norm**2
    expected = np.eye(SIZE) - STEP_SIZE * bound / norm * across @ HESSIAN
    np.testing.assert_allclose(jax.jacrev(adapted)(start), expected, rtol=1e-11)
    first = jax.jacrev(lambda x: adapted(x, True))(start)
    np.testing.assert_allclose(first, np.eye(SIZE), rtol=1e-12)


def test_a_gradient_of_zero_can_be_bounded(x64):
    """At the minimum: no step, and the derivative of a gradient that is not bounded."""
    jacobian = jax.jacrev(
        lambda x: unroll(quadratic, x, STEP_SIZE, 1, clip_norm=0.5)[0]
    )(jnp.array(TARGET))
    np.testing.assert_allclose(jacobian, np.eye(SIZE) - STEP_SIZE * HESSIAN, rtol=1e-12)


def test_a_tree_of_step_sizes_in_jit_and_vmap():
    starts = jnp.asarray(RNG.normal(size=(3, SIZE)), jnp.float32)
    scales = jnp.array([0.5, 1.0, 2.0])
    target = jnp.asarray(TARGET, jnp.float32)

    def gradient(start, scale):
        sizes = {name: scale * size for name, size in SIZES.items()}
        return jax.grad(meta_loss, argnums=(0, 2))(start, sizes, target)

    mapped = jax.jit(jax.vmap(gradient))(starts, scales)
    for i, (start, scale) in enumerate(zip(starts, scales, strict=True)):
        sizes = {name: float(scale) * size for name, size in SIZES.items()}
        power = np.linalg.matrix_power(shrink_by(sizes), STEPS)
        outer = CURVATURE @ (TARGET + power @ (np.asarray(start) - TARGET))
        expected = power.T @ outer, (np.eye(SIZE) - power).T @ outer
        for found, by_hand in zip(mapped, expected, strict=True):
            np.testing.assert_allclose(found[i], by_hand, rtol=1e-4, atol=1e-5)


def moved_by_ones(variables, config):
    """How far each parameter of the encoders moves under a gradient of one."""
    encoders, _ = pop_encoders(variables)
    start = jax.tree.map(jnp.zeros_like, encoders)
    ones = jax.tree.map(jnp.ones_like, encoders)
    moved = descend(start, ones, step_sizes(variables, config))
    assert jax.tree.structure(moved) == jax.tree.structure(encoders)
    return jax.tree_util.tree_leaves_with_path(jax.tree.map(lambda x: -x, moved))


def test_learned_step_sizes_are_multiples_of_the_configurations(
    minimal, minimal_variables
):
    """One for each module of the encoders, all of them different here."""
    config = dataclasses.replace(minimal.adapt, step_size=0.25)
    learned = minimal_variables["weighting"]["log_steps"]
    assert len({float(leaf) for leaf in jax.tree.leaves(learned)}) > 10
    for path, leaf in moved_by_ones(minimal_variables, config):
        encoder, module = path[0].key, path[1].key
        expected = 0.25 * np.exp(np.float64(learned[encoder][module]))
        np.testing.assert_allclose(leaf, np.full(leaf.shape, expected), rtol=1e-6)


def test_held_norms_are_the_modules_that_have_statistics(minimal, minimal_variables):
    """And no other parameter's step changes."""
    config = dataclasses.replace(minimal.adapt, adapt_norm=False)
    held = moved_by_ones(minimal_variables, config)
    free = moved_by_ones(minimal_variables, minimal.adapt)
    statistics = {
        tuple(step.key for step in path[:-1])
        for path, _ in jax.tree_util.tree_leaves_with_path(
            minimal_variables["batch_stats"]
        )
    }
    count = 0
    for (path, leaf), (_, before) in zip(held, free, strict=True):
        if tuple(step.key for step in path[:-1]) in statistics:
            assert (np.asarray(leaf) == 0).all(), path
            count += 1
        else:
            assert (np.asarray(leaf) == np.asarray(before)).all(), path
            assert (np.asarray(leaf) > 0).all(), path
    assert count > 10
