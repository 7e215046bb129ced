"""Eq. 11: softmax weights, normalisation by moving averages."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from prism_jax.losses.weighting import update_scale, weighted_auxiliary

LOGITS = jnp.asarray([0.3, -1.0, 2.0])
LOSSES = jnp.asarray([0.2, 5.0, 0.01])
SCALES = jnp.asarray([0.1, 4.0, 0.02])
WEIGHTS = scipy.special.softmax(LOGITS)

gradients = jax.jit(jax.grad(weighted_auxiliary, (0, 1, 2)))


def test_weighted_sum_of_normalised_losses():
    expected = WEIGHTS @ (LOSSES / SCALES)
    batch = jnp.stack([LOSSES, 2 * LOSSES])
    mapped = jax.jit(jax.vmap(weighted_auxiliary, (None, 0, None)))
    values = mapped(LOGITS, batch, SCALES)
    assert np.allclose(values, [expected, 2 * expected], rtol=1e-6)


def test_gradients_reach_logits_and_losses_but_not_scales():
    to_logits, to_losses, to_scales = gradients(LOGITS, LOSSES, SCALES)
    normalised = LOSSES / SCALES
    expected = WEIGHTS * (normalised - WEIGHTS @ normalised)
    assert np.allclose(to_logits, expected, rtol=1e-5)
    assert np.allclose(to_losses, WEIGHTS / SCALES, rtol=1e-6)
    assert np.all(np.asarray(to_scales) == 0)


def test_a_scale_not_measured_yet_leaves_the_loss_alone():
    arguments = (LOGITS, LOSSES, jnp.zeros(3))
    assert np.allclose(weighted_auxiliary(*arguments), WEIGHTS @ LOSSES, rtol=1e-6)
    assert all(np.all(np.isfinite(g)) for g in gradients(*arguments))


def test_scale_is_a_moving_average_that_starts_at_the_first_value():
    values = jnp.asarray(np.random.default_rng(2).uniform(0.1, 2.0, (6, 3)))
    expected, scale = values[0], update_scale(jnp.zeros(3), values[0])
    assert np.allclose(scale, expected, rtol=1e-6)
    for row in values[1:]:
        expected, scale = 0.99 * expected + 0.01 * row, update_scale(scale, row)
    assert np.allclose(scale, expected, rtol=1e-5)
    gradient = jax.grad(lambda v: jnp.sum(update_scale(SCALES, v)))(LOSSES)
    assert np.all(np.asarray(gradient) == 0)
