"""Eq. 11: softmax weights, normalisation by moving averages, entropy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats

from prism_jax.losses.weighting import (
    entropy,
    loss_weights,
    update_scale,
    weighted_auxiliary,
)

LOGITS = jnp.asarray([0.3, -1.0, 2.0])
LOSSES = jnp.asarray([0.2, 5.0, 0.01])
SCALES = jnp.asarray([0.1, 4.0, 0.02])


def test_weights_are_a_softmax():
    assert np.allclose(loss_weights(LOGITS), scipy.special.softmax(LOGITS), rtol=1e-6)
    shifted = loss_weights(LOGITS + 1000)
    assert np.allclose(shifted, loss_weights(LOGITS), atol=1e-6)


def test_weighted_sum_of_normalised_losses():
    expected = scipy.special.softmax(LOGITS) @ (LOSSES / SCALES)
    value = jax.jit(weighted_auxiliary)(LOGITS, LOSSES, SCALES)
    assert np.allclose(value, expected, rtol=1e-6)
    batch = jnp.stack([LOSSES, 2 * LOSSES])
    values = jax.vmap(weighted_auxiliary, (None, 0, None))(LOGITS, batch, SCALES)
    assert np.allclose(values, [expected, 2 * expected], rtol=1e-6)


def test_gradients_reach_logits_and_losses_but_not_scales():
    to_logits, to_losses, to_scales = jax.grad(weighted_auxiliary, (0, 1, 2))(
        LOGITS, LOSSES, SCALES
    )
    weights, normalised = scipy.special.softmax(LOGITS), LOSSES / SCALES
    expected = weights * (normalised - weights @ normalised)
    assert np.allclose(to_logits, expected, rtol=1e-5)
    assert np.allclose(to_losses, weights / SCALES, rtol=1e-6)
    assert np.all(np.asarray(to_scales) == 0)


def test_a_scale_not_measured_yet_leaves_the_loss_alone():
    arguments = (LOGITS, LOSSES, jnp.zeros(3))
    expected = scipy.special.softmax(LOGITS) @ LOSSES
    assert np.allclose(weighted_auxiliary(*arguments), expected, rtol=1e-6)
    gradients = jax.grad(weighted_auxiliary, (0, 1, 2))(*arguments)
    assert all(np.all(np.isfinite(g)) for g in gradients)


def test_scale_is_a_moving_average_that_starts_at_the_first_value():
    values = np.random.default_rng(2).uniform(0.1, 2.0, (6, 3))
    expected = values[0]
    scale = jax.jit(update_scale)(jnp.zeros(3), jnp.asarray(values[0], jnp.float32))
    assert np.allclose(scale, expected, rtol=1e-6)
    for row in values[1:]:
        expected = 0.99 * expected + 0.01 * row
        scale = update_scale(scale, jnp.asarray(row, jnp.float32))
    assert np.allclose(scale, expected, rtol=1e-5)


def test_scale_has_no_gradient():
    gradient = jax.grad(lambda v: jnp.sum(update_scale(SCALES, v)))(LOSSES)
    assert np.all(np.asarray(gradient) == 0)


@pytest.mark.parametrize("weights", [[1 / 3] * 3, [0.7, 0.2, 0.1], [1.0, 0.0, 0.0]])
def test_entropy(weights):
    expected = scipy.stats.entropy(weights)
    assert np.allclose(entropy(jnp.asarray(weights)), expected, atol=1e-6)


def test_entropy_of_saturated_weights_has_finite_gradients():
    logits = jnp.asarray([500.0, 0.0, -500.0])
    assert loss_weights(logits)[2] == 0
    gradient = jax.grad(lambda x: entropy(loss_weights(x)))(logits)
    assert np.all(np.isfinite(gradient))
