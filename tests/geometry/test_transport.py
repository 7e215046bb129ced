"""Sinkhorn against OTT-JAX, the linear programme and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from ott.geometry import geometry
from ott.solvers import linear
from scipy.optimize import linear_sum_assignment

from prism_jax.geometry.transport import sinkhorn

RNG = np.random.default_rng(0)
transport = jax.jit(lambda cost, epsilon: sinkhorn(cost, epsilon, 400))


def squared_costs(rows: int = 8, columns: int = 11) -> jax.Array:
    x, y = RNG.normal(size=(rows, 4)), RNG.normal(size=(columns, 4))
    return jnp.asarray(((x[:, None] - y[None]) ** 2).sum(-1))


def test_agrees_with_ott_with_its_gradient(x64):
    # Its gradient is by implicit differentiation, ours by unrolling.
    cost = squared_costs()
    epsilon = 0.1 * float(cost.mean())

    def ott_cost_and_plan(cost):
        problem = geometry.Geometry(cost_matrix=cost, epsilon=epsilon)
        out = linear.solve(problem, threshold=1e-10, max_iterations=5000)
        return jnp.sum(out.matrix * cost), out.matrix

    def our_cost_and_plan(cost):
        return sinkhorn(cost, epsilon, 500)[::-1]

    oracle = jax.jit(jax.value_and_grad(ott_cost_and_plan, has_aux=True))
    ours = jax.jit(jax.value_and_grad(our_cost_and_plan, has_aux=True))
    (expected, expected_plan), expected_gradient = oracle(cost)
    (found, plan), gradient = ours(cost)
    assert found == pytest.approx(float(expected), rel=1e-7)
    assert np.allclose(plan, expected_plan, atol=1e-9)
    assert np.allclose(gradient, expected_gradient, atol=1e-6)
    # The gradient is not the plan: without the plan's own derivative this would fail.
    assert np.abs(expected_gradient - expected_plan).max() > 1e-3


def test_marginals():
    cost = squared_costs().astype(jnp.float32)
    plan, total = transport(cost, 0.05 * cost.mean())
    assert np.allclose(plan.sum(axis=1), 1 / 8, atol=1e-4 / 8)
    assert np.allclose(plan.sum(axis=0), 1 / 11, rtol=1e-5)
    assert total == pytest.approx(float((plan * cost).sum()), rel=1e-6)
    # A large epsilon makes rows and columns independent.
    plan, _ = transport(cost, 1e6)
    assert np.allclose(plan, 1 / 88, rtol=1e-4)


def test_small_epsilon_is_the_assignment(x64):
    x = RNG.normal(size=(9, 4))
    y = RNG.permutation(x) + 0.2 * RNG.normal(size=(9, 4))
    cost = jnp.asarray(((x[:, None] - y[None]) ** 2).sum(-1))
    rows, columns = linear_sum_assignment(np.asarray(cost))
    expected = np.zeros((9, 9))
    expected[rows, columns] = 1 / 9
    plan, total = transport(cost, 0.01 * cost.mean())
    assert plan.dtype == cost.dtype == jnp.float64
    assert np.allclose(plan, expected, atol=1e-3)
    assert total == pytest.approx(np.asarray(cost)[rows, columns].mean(), rel=1e-3)


def test_gradients(x64):
    cost = squared_costs(3, 4)
    check_grads(
        jax.jit(lambda cost, epsilon: sinkhorn(cost, epsilon, 30)),
        (cost, jnp.array(0.7)),
        order=2,
        modes=("rev",),
    )


def test_the_unit_of_costs_changes_nothing_and_far_ones_do_not_underflow():
    cost = squared_costs().astype(jnp.float32)
    epsilon = 0.05 * cost.mean()
    plan, total = transport(cost, epsilon)
    for factor in (1e-6, 1e6):
        scaled_plan, scaled_total = transport(cost * factor, epsilon * factor)
        assert np.allclose(scaled_plan, plan, atol=1e-5)
        assert scaled_total == pytest.approx(float(total * factor), rel=1e-4)
    # A row whose every cost is 1,000 epsilon must still send its mass.
    plan, _ = transport(cost.at[2].add(1000.0), 1.0)
    assert np.allclose(plan.sum(axis=1), 1 / 8, rtol=1e-3)


def test_vmap():
    costs = jnp.stack([squared_costs(), squared_costs()]).astype(jnp.float32)
    plans, totals = jax.jit(jax.vmap(lambda c: sinkhorn(c, 1.0, 400)))(costs)
    for i in range(2):
        plan, total = transport(costs[i], 1.0)
        assert np.allclose(plans[i], plan, atol=1e-6)
        assert totals[i] == pytest.approx(float(total), rel=1e-5)
