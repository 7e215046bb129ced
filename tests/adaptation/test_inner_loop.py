"""Unrolled gradient steps against their closed form on a quadratic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.inner_loop import unroll

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
