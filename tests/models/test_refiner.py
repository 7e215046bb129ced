"""Eq. 2 and its bounds."""

import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.models.auxiliary import Refiner
from prism_jax.models.config import AuxiliaryConfig

CONFIG = AuxiliaryConfig(hidden=8)
RNG = np.random.default_rng(0)
POINTS = jnp.asarray(RNG.uniform(-1, 1, (40, 3)), jnp.float32)
FEATURES = jnp.asarray(RNG.normal(size=(40, 6)), jnp.float32)
FRESH = Refiner(CONFIG).init(jax.random.key(0), POINTS, FEATURES)
VARIABLES = jax.tree.map(
    lambda leaf: jnp.asarray(0.3 * RNG.normal(size=leaf.shape), jnp.float32), FRESH
)

refine = jax.jit(Refiner(CONFIG).apply)


def test_equation_2():
    g = jax.tree.map(np.float64, VARIABLES["params"]["g"])
    x = np.concatenate([POINTS, FEATURES], -1, dtype=np.float64)
    x = np.maximum(x @ g["dense_0"]["kernel"] + g["dense_0"]["bias"], 0)
    offsets = np.tanh(x @ g["dense_1"]["kernel"] + g["dense_1"]["bias"])
    expected = np.clip(np.asarray(POINTS) + 0.1 * offsets, -1, 1)
    np.testing.assert_allclose(refine(VARIABLES, POINTS, FEATURES), expected, atol=1e-6)
    batch = POINTS.reshape(2, 4, 5, 3), FEATURES.reshape(2, 4, 5, 6)
    together = refine(VARIABLES, *batch).reshape(40, 3)
    np.testing.assert_allclose(together, expected, atol=1e-6)


def test_no_point_moves_further_than_the_bounds():
    module = Refiner(AuxiliaryConfig(hidden=8, max_offset=0.03, max_coordinate=2.0))
    huge = jax.tree.map(lambda leaf: 1e3 * leaf, VARIABLES)
    offset = np.abs(module.apply(huge, POINTS, FEATURES) - POINTS)
    assert offset.max() <= 0.03 + 1e-7
    # Saturated, so that the bound is seen to be the bound.
    assert np.median(offset) > 0.99 * 0.03
    outside = 3 * jnp.sign(POINTS)
    assert np.array_equal(module.apply(VARIABLES, outside, FEATURES), outside * 2 / 3)
    assert np.array_equal(refine(VARIABLES, outside, FEATURES), jnp.sign(POINTS))


def test_starts_as_the_identity_and_learns():
    assert np.array_equal(refine(FRESH, 0.5 * POINTS, FEATURES), 0.5 * POINTS)

    @jax.jit
    def slopes(*arguments):
        loss = lambda *arguments: (refine(*arguments) ** 2).sum()  # noqa: E731
        return jax.grad(loss, argnums=(0, 1, 2))(*arguments)

    last = slopes(FRESH, POINTS, FEATURES)[0]["params"]["g"]["dense_1"]
    for leaf in jax.tree.leaves((last, slopes(VARIABLES, POINTS, FEATURES))):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0
