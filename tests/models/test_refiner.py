"""Eq. 2 and its bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.models.config import AuxiliaryConfig
from prism_jax.models.refiner import Refiner

CONFIG = AuxiliaryConfig(hidden=8)
RNG = np.random.default_rng(0)
POINTS = jnp.asarray(RNG.uniform(-1, 1, (40, 3)), jnp.float32)
FEATURES = jnp.asarray(RNG.normal(size=(40, 6)), jnp.float32)
FRESH = Refiner(CONFIG).init(jax.random.key(0), POINTS, FEATURES)
VARIABLES = jax.tree.map(
    lambda leaf: jnp.asarray(0.3 * RNG.normal(size=leaf.shape), jnp.float32), FRESH
)

refine = jax.jit(Refiner(CONFIG).apply)


def scaled(factor):
    return jax.tree.map(lambda leaf: factor * leaf, VARIABLES)


def offsets_by_hand(variables, points, features):
    """g(c, phi) in NumPy: one hidden layer with a ReLU."""
    g = jax.tree.map(np.float64, variables["params"]["g"])
    x = np.concatenate([points, features], -1, dtype=np.float64)
    x = np.maximum(x @ g["dense_0"]["kernel"] + g["dense_0"]["bias"], 0)
    return x @ g["dense_1"]["kernel"] + g["dense_1"]["bias"]


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_equation_2(factor):
    variables = scaled(factor)
    g = offsets_by_hand(variables, POINTS, FEATURES)
    expected = np.clip(np.asarray(POINTS) + 0.1 * np.tanh(g), -1, 1)
    np.testing.assert_allclose(refine(variables, POINTS, FEATURES), expected, atol=1e-6)


@pytest.mark.parametrize("max_offset", [0.1, 0.03])
def test_no_point_moves_further_than_the_bound(max_offset):
    module = Refiner(AuxiliaryConfig(hidden=8, max_offset=max_offset))
    inner = 0.5 * POINTS
    moved = module.apply(scaled(1e3), inner, FEATURES)
    offset = np.abs(np.asarray(moved) - np.asarray(inner))
    assert offset.max() <= max_offset + 1e-7
    # Saturated, so that the bound is seen to be the bound.
    assert np.median(offset) > 0.99 * max_offset


def test_a_wider_bound_leaves_what_is_inside():
    module = Refiner(AuxiliaryConfig(hidden=8, max_coordinate=2.0))
    outside = 3 * jnp.sign(POINTS)
    assert np.array_equal(module.apply(VARIABLES, outside, FEATURES), outside * 2 / 3)
    inside = module.apply(FRESH, 1.9 * POINTS, FEATURES)
    assert np.array_equal(inside, 1.9 * POINTS)


def test_stays_in_the_workspace_exactly():
    edge = jnp.sign(POINTS)
    moved = np.asarray(refine(scaled(1e3), edge, FEATURES))
    assert np.abs(moved).max() == 1.0
    assert (np.abs(moved) < 1).any()
    outside = np.asarray(refine(VARIABLES, 3 * edge, FEATURES))
    assert np.array_equal(outside, np.asarray(edge))


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_starts_as_the_identity_whatever_the_features(scale):
    moved = refine(FRESH, 0.5 * POINTS, scale * FEATURES)
    assert np.array_equal(moved, 0.5 * POINTS)


def test_from_the_identity_on_it_learns():
    def loss(variables):
        return (refine(variables, 0.5 * POINTS, FEATURES) ** 2).sum()

    last = jax.grad(loss)(FRESH)["params"]["g"]["dense_1"]
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(last))


def test_gradients_are_finite_and_reach_the_features():
    def loss(variables, points, features):
        return (refine(variables, points, features) ** 2).sum()

    grads = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(VARIABLES, POINTS, FEATURES)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(grads))


def test_any_leading_axes():
    together = refine(
        VARIABLES, POINTS.reshape(2, 4, 5, 3), FEATURES.reshape(2, 4, 5, 6)
    )
    alone = refine(VARIABLES, POINTS, FEATURES)
    np.testing.assert_allclose(together.reshape(40, 3), alone, atol=1e-6)
