"""Layers: what `test_crapcn_parity.py`, which has their values, does not ask."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from prism_jax.geometry import kernels
from prism_jax.models.layers import MLP, Conv, ResidualMLP, SplitPoints, highest
from tests.trees import drawn

RNG = np.random.default_rng(0)


def normal(*shape):
    """Single precision, or double in the tests of gradients."""
    return jnp.asarray(RNG.normal(size=shape), jnp.result_type(float))


def test_highest_is_the_maximum_and_so_is_its_derivative():
    features, weights = normal(2, 4, 8, 3), normal(2, 4, 3)
    np.testing.assert_array_equal(jax.jit(highest)(features), features.max(-2))
    derivatives = [
        jax.grad(lambda x, pool=pool: (pool(x) ** 2 * weights).sum())(features)
        for pool in (highest, lambda x: x.max(-2))
    ]
    np.testing.assert_array_equal(*derivatives)


def test_highest_of_equal_points_and_of_none():
    """The first has the derivative, which divides by nothing; NaN gives NaN."""
    gradient = jax.grad(lambda x: highest(x).sum())(jnp.array([[1.0], [2.0], [2.0]]))
    np.testing.assert_array_equal(gradient[:, 0], [0, 1, 0])
    points = jnp.array([[1.0, 3.0], [jnp.nan, -jnp.inf]])
    np.testing.assert_array_equal(highest(points), [jnp.nan, 3.0])
    once = jax.grad(lambda x: (highest(x) ** 3).sum())
    twice = jax.grad(lambda x: once(x).sum())
    assert "div" not in str(jax.make_jaxpr(twice)(jnp.ones((4, 2))))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("module", [MLP((4, 3)), ResidualMLP(4, 3), SplitPoints(3, 2)])
def test_gradients(module):
    parts = [normal(4, 3)]
    if not isinstance(module, SplitPoints):
        parts.append(normal(2, 2))
    variables = drawn(module, *parts)

    @jax.jit
    def total(variables, *parts):
        return jnp.sin(module.apply(variables, *parts)).sum()

    check_grads(total, (variables, *parts), order=2, modes=["rev"], eps=1e-6)


def test_conv_for_a_gpu_keeps_its_windows_apart(monkeypatch):
    x, module = normal(2, 8, 8, 3), Conv(4, 3)
    variables = module.init(jax.random.key(0), x)

    def convolved(x):
        return module.apply(variables, x)

    expected = convolved(x)
    monkeypatch.setattr(kernels, "on_gpu", lambda: True)
    assert "optimization_barrier" in str(jax.make_jaxpr(convolved)(x))
    np.testing.assert_array_equal(convolved(x), expected)


@pytest.mark.parametrize(("size", "strides"), [(1, 2), (3, 1), (7, 2)])
def test_conv_is_flax_conv(size, strides):
    x = normal(2, 9, 6, 3)
    module = Conv(4, size, strides)
    oracle = nn.Conv(4, (size, size), strides, use_bias=False)

    @jax.jit
    def everything(x):
        variables = [m.init(jax.random.key(0), x) for m in (module, oracle)]

        def both(apply):
            total = lambda v, x: (apply(v, x) ** 3).sum()  # noqa: E731
            return jax.value_and_grad(total, argnums=(0, 1))(variables[0], x)

        mapped = jax.vmap(lambda x: module.apply(variables[0], x))(x)
        outputs = mapped, oracle.apply(variables[0], x)
        return variables, (both(module.apply), both(oracle.apply)), outputs

    (ours, flax), derivatives, (mapped, expected) = everything(x)
    np.testing.assert_array_equal(ours["params"]["kernel"], flax["params"]["kernel"])
    for a, b in zip(*map(jax.tree.leaves, derivatives), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(mapped, expected, atol=1e-5)
