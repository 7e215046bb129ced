"""The objective of Eq. 13, in double precision: its terms, and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.objective import Losses
from prism_jax.adaptation.objective import test_time_objective as objective
from prism_jax.losses.alignment import alignment_loss
from prism_jax.losses.denoise import denoise_loss
from prism_jax.losses.depth import depth_supervised
from prism_jax.losses.normal import normal_loss
from prism_jax.models.prism import branches, predict, prepare_input, read_depth
from prism_jax.models.variables import pop_encoders, put_encoders

LAMBDAS = {
    "lambda_smooth": 0.3,
    "lambda_offset": 0.7,
    "lambda_sigma": 1.3,
    "lambda_transport": 0.6,
    "depth_weight": 2.0,
}
# Gradients are stopped at the PCA anchors of the normals and at the entropy of the
# transport, though both move with the parameters: the normals get no weight here, and
# the transport none. What is left is differentiable wherever no assignment flips.
SMOOTH_LOGITS = (-1e9, 0.3, -0.4)
LOGITS = (0.5, 0.3, -0.4)
SCALES = (0.5, 0.02, 7.0)


@pytest.fixture(scope="module", autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def as_double(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), tree)


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config.with_adapt(**LAMBDAS)


@pytest.fixture(scope="module")
def frame(config, tiny_frames, double):
    partials, cameras = as_double(tiny_frames)
    camera = jax.tree.map(lambda leaf: leaf[0], cameras)
    key = jax.random.key(config.adapt.seed)
    return jax.jit(lambda p, c: prepare_input(p, c, key, config.model))(
        partials[0], camera
    )


@pytest.fixture(scope="module")
def variables(minimal_variables, double):
    """Not fresh ones: their biases of zero leave many a ReLU exactly at its kink."""
    weighting = {"logits": jnp.array(LOGITS), "scales": jnp.array(SCALES)}
    return as_double({**minimal_variables, "weighting": weighting})


@pytest.fixture(scope="module")
def evaluate(config, frame, quick_jit):
    """All that the tests look at, compiled once."""
    smooth = config.with_adapt(lambda_transport=0.0)

    def value(encoders, rest):
        return objective(put_encoders(encoders, rest), frame, smooth)[0].objective

    @quick_jit
    def evaluate(encoders, rest):
        variables = put_encoders(encoders, rest)
        losses, prediction = objective(variables, frame, config)
        features = read_depth(variables, frame, config.model)
        again = predict(variables, frame, config.model)
        seen = branches(variables, frame, again, features, config.model)
        smooth_value, gradient = jax.value_and_grad(value)(encoders, rest)
        return losses, prediction, seen, smooth_value, gradient

    return evaluate


@pytest.fixture(scope="module")
def evaluated(evaluate, variables):
    return evaluate(*pop_encoders(variables))


def test_terms_are_the_losses_of_their_equations(evaluated, frame, config, quick_jit):
    losses, prediction, seen, *_ = evaluated

    @quick_jit
    def terms(points, seen):
        denoised = frame.perturbed + seen.offsets
        return (
            depth_supervised(points, frame.partial, frame.view),
            normal_loss(seen.normals, points, 0.3, config.adapt.normal_neighbors),
            denoise_loss(denoised, frame.upsampled, seen.offsets, 0.7),
            alignment_loss(seen.tokens_3d, seen.tokens_depth, 1.3, 0.6, 0.05),
        )

    expected = terms(prediction.points, seen)
    found = [getattr(losses, name) for name in Losses._fields[1:]]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert min(expected) > 0


def test_objective_is_the_weighted_sum(evaluated):
    """Eq. 11 and 13: softmax weights over the losses divided by their scales."""
    losses, *_ = evaluated
    weights = np.exp(LOGITS) / np.exp(LOGITS).sum()
    terms = np.array([losses.normal, losses.denoise, losses.align])
    expected = LAMBDAS["depth_weight"] * losses.depth_consistency
    expected += (weights * terms / SCALES).sum()
    np.testing.assert_allclose(losses.objective, expected, rtol=1e-12)
    assert all(np.ndim(term) == 0 for term in losses._asdict().values())
    assert set(losses._asdict()) == set(Losses._fields)


@pytest.mark.parametrize("moving", ["point_encoder", "depth_encoder"])
def test_gradient_against_finite_differences(evaluate, variables, moving):
    encoders, rest = pop_encoders(variables)
    weighting = {**rest["weighting"], "logits": jnp.array(SMOOTH_LOGITS)}
    rest = {**rest, "weighting": weighting}
    rng = np.random.default_rng(0)
    direction = {
        name: jax.tree.map(
            lambda x, on=name == moving: on * rng.normal(size=x.shape), tree
        )
        for name, tree in encoders.items()
    }
    step = 1e-7

    def at(sign):
        moved = jax.tree.map(lambda p, d: p + sign * step * d, encoders, direction)
        return float(evaluate(moved, rest)[3])

    gradient = evaluate(encoders, rest)[4]
    along = jax.tree.map(lambda g, d: (g * d).sum(), gradient, direction)
    expected = float(sum(jax.tree.leaves(along)))
    assert abs(expected) > 0.01
    np.testing.assert_allclose((at(1) - at(-1)) / (2 * step), expected, rtol=1e-5)
