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


def closed_form(num_steps, start=START, step_size=STEP_SIZE):
    """x_k - target = (I - a H)^k (x_0 - target)."""
    shrink = np.eye(SIZE) - step_size * HESSIAN
    return TARGET + np.linalg.matrix_power(shrink, num_steps) @ (start - TARGET)


@pytest.mark.parametrize("num_steps", [0, 1, 4])
def test_parameters_losses_and_extras(x64, num_steps):
    adapted, (losses, seen) = unroll(quadratic, jnp.array(START), STEP_SIZE, num_steps)
    np.testing.assert_allclose(adapted, closed_form(num_steps), rtol=1e-12)
    before = [closed_form(k) for k in range(num_steps)]
    expected = [float(quadratic(x)[0]) for x in before]
    np.testing.assert_allclose(losses, expected, rtol=1e-12)
    assert losses.shape == (num_steps,)
    np.testing.assert_allclose(seen, np.reshape(before, (-1, SIZE)), rtol=1e-12)


def test_trees_of_parameters(x64):
    first = {"a": jnp.array(START[:2]), "b": {"c": jnp.array(START[2:])}}
    adapted, _ = unroll(
        lambda tree: quadratic(jnp.concatenate(jax.tree.leaves(tree))),
        first,
        STEP_SIZE,
        3,
    )
    assert jax.tree.structure(adapted) == jax.tree.structure(first)
    together = jnp.concatenate(jax.tree.leaves(adapted))
    np.testing.assert_allclose(together, closed_form(3), rtol=1e-12)


def test_derivative_in_the_initial_parameters_is_of_second_order(x64):
    """d x_K / d x_0 = (I - a H)^K; a first-order loop would give the identity."""
    jacobian = jax.jacrev(lambda x: unroll(quadratic, x, STEP_SIZE, 3)[0])
    shrink = np.eye(SIZE) - STEP_SIZE * HESSIAN
    expected = np.linalg.matrix_power(shrink, 3)
    np.testing.assert_allclose(jacobian(jnp.array(START)), expected, rtol=1e-11)
    assert np.abs(expected - np.eye(SIZE)).max() > 0.1


def test_derivative_in_the_step_size(x64):
    """d x_K / d a = -K H (I - a H)^(K - 1) (x_0 - target)."""
    derivative = jax.jacfwd(lambda a: unroll(quadratic, jnp.array(START), a, 3)[0])
    shrink = np.eye(SIZE) - STEP_SIZE * HESSIAN
    expected = -3 * HESSIAN @ shrink @ shrink @ (START - TARGET)
    np.testing.assert_allclose(derivative(STEP_SIZE), expected, rtol=1e-11)


def test_derivative_in_what_the_loss_closes_over(x64):
    """d x_K / d target = I - (I - a H)^K."""

    def adapted(target):
        start = jnp.array(START)
        return unroll(lambda x: quadratic(x, target), start, STEP_SIZE, 3)[0]

    shrink = np.eye(SIZE) - STEP_SIZE * HESSIAN
    expected = np.eye(SIZE) - np.linalg.matrix_power(shrink, 3)
    jacobian = jax.jacrev(adapted)(jnp.array(TARGET))
    np.testing.assert_allclose(jacobian, expected, rtol=1e-10, atol=1e-14)


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


def test_mapped_over_starts():
    starts = jnp.asarray(RNG.normal(size=(3, SIZE)), jnp.float32)
    target = jnp.asarray(TARGET, jnp.float32)

    def adapted(start):
        return unroll(lambda x: quadratic(x, target), start, STEP_SIZE, 2)[0]

    expected = [closed_form(2, np.asarray(start)) for start in starts]
    np.testing.assert_allclose(jax.jit(jax.vmap(adapted))(starts), expected, rtol=1e-5)


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


def test_orders_agree_where_the_loss_has_no_curvature(x64):
    slope = jnp.array(RNG.normal(size=SIZE))

    def loss(start, sizes, first_order):
        adapted, _ = unroll(
            lambda tree: (slope @ flat(tree), None),
            grouped(start),
            sizes,
            STEPS,
            first_order,
        )
        return (flat(adapted) ** 3).sum()

    gradient = jax.grad(loss, argnums=(0, 1))
    arguments = jnp.array(START), jax.tree.map(jnp.array, SIZES)
    second, first = gradient(*arguments, False), gradient(*arguments, True)
    for a, b in zip(*map(jax.tree.leaves, (first, second)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
        assert np.abs(a).max() > 0.01


def test_one_step_is_descend(x64):
    """The same values and derivatives, by either name, in either order."""

    def once(start, sizes, first_order):
        grads = jax.grad(lambda tree: quadratic(flat(tree))[0])(grouped(start))
        return flat(descend(grouped(start), grads, sizes, first_order))

    def unrolled(start, sizes, first_order):
        def loss_fn(tree):
            return quadratic(flat(tree))

        return flat(unroll(loss_fn, grouped(start), sizes, 1, first_order)[0])

    arguments = jnp.array(START), jax.tree.map(jnp.array, SIZES)
    expected = TARGET + shrink_by(SIZES) @ (START - TARGET)
    for first_order in (False, True):
        np.testing.assert_allclose(once(*arguments, first_order), expected, rtol=1e-12)
        pair = [
            jax.jacrev(fn, argnums=(0, 1))(*arguments, first_order)
            for fn in (once, unrolled)
        ]
        for a, b in zip(*map(jax.tree.leaves, pair), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)
        shrink = np.eye(SIZE) if first_order else shrink_by(SIZES)
        np.testing.assert_allclose(pair[0][0], shrink, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        (0.5, [0.5, 0.5, 0.5]),
        ({"a": 0.5, "b": 0.25}, [0.5, 0.25, 0.25]),
        ({"a": 0.5, "b": {"c": 0.25, "d": 0.0}}, [0.5, 0.25, 0.0]),
    ],
)
def test_a_step_size_holds_for_all_below_its_place(sizes, expected):
    params = {"a": jnp.zeros(2), "b": {"c": jnp.zeros(()), "d": jnp.zeros((1, 3))}}
    moved = descend(params, jax.tree.map(jnp.ones_like, params), sizes)
    assert jax.tree.structure(moved) == jax.tree.structure(params)
    for leaf, size in zip(jax.tree.leaves(moved), expected, strict=True):
        assert (np.asarray(leaf) == -size).all()


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


@pytest.mark.parametrize("sizes", [{"a": 0.1}, {"a": 0.1, "c": 0.1}])
def test_step_sizes_of_another_tree_are_refused(sizes):
    params = {"a": jnp.zeros(2), "b": jnp.zeros(2)}
    with pytest.raises(ValueError, match="tree"):
        descend(params, params, sizes)


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


def test_unlearned_step_sizes_are_the_configurations(minimal, minimal_variables):
    weighting = minimal_variables["weighting"]
    unlearned = jax.tree.map(jnp.zeros_like, weighting["log_steps"])
    variables = {
        **minimal_variables,
        "weighting": {**weighting, "log_steps": unlearned},
    }
    for _, leaf in moved_by_ones(variables, minimal.adapt):
        assert (np.asarray(leaf) == np.float32(minimal.adapt.step_size)).all()


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
