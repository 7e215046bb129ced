"""The objective of Eq. 13, in double precision: its terms, and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.config import MetaConfig
from prism_jax.adaptation.meta import _descended
from prism_jax.adaptation.objective import Losses, auxiliary_losses
from prism_jax.adaptation.objective import test_time_objective as objective
from prism_jax.losses.alignment import alignment_loss
from prism_jax.losses.denoise import denoise_loss
from prism_jax.losses.depth import depth_consistency
from prism_jax.losses.normal import normal_loss
from prism_jax.models.prism import branches, predict, prepare_input, read_depth
from prism_jax.models.variables import pop_encoders, put_encoders
from tests.trees import as_double, dot, row

pytestmark = pytest.mark.xdist_group("objective")

# Gradients are stopped at the PCA anchors of the normals and at the entropy of the
# transport, though both move with the parameters: the normals get no weight where a
# gradient is checked, and the transport none.
LAMBDAS = {
    "lambda_smooth": 0.3,
    "lambda_offset": 0.7,
    "lambda_sigma": 1.3,
    "lambda_transport": 0.0,
    "depth_weight": 2.0,
}
SMOOTH_LOGITS = (-1e9, 0.3, -0.4)
LOGITS = (0.5, 0.3, -0.4)
SCALES = (0.5, 0.02, 7.0)


@pytest.fixture(scope="module", autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def variables(minimal_variables, double):
    """Not fresh ones: their biases of zero leave many a ReLU exactly at its kink."""
    weighting = {"logits": jnp.array(LOGITS), "scales": jnp.array(SCALES)}
    return as_double({**minimal_variables, "weighting": weighting})


@pytest.fixture(scope="module")
def evaluate(minimal, tiny_frames, quick_jit, double):
    """All that the tests look at, compiled once."""
    config = minimal.config.with_adapt(**LAMBDAS)
    settings = config.adapt
    partial, camera = row(as_double(tiny_frames), 0)

    @quick_jit
    def evaluate(encoders, rest):
        key = jax.random.key(settings.seed)
        frame = prepare_input(partial, camera, key, config.model)

        def value(encoders):
            variables = put_encoders(encoders, rest)
            losses, _ = objective(variables, frame, config)
            return losses.objective, losses

        (_, losses), gradient = jax.value_and_grad(value, has_aux=True)(encoders)
        variables = put_encoders(encoders, rest)
        features = read_depth(variables, frame, config.model)
        made = predict(variables, frame, config.model)
        seen = branches(variables, frame, made, features, config.model)
        denoised = frame.perturbed + seen.offsets
        terms = (
            depth_consistency(made.points, frame.partial, frame.view),
            normal_loss(seen.normals, made.points, 0.3, settings.normal_neighbors),
            denoise_loss(denoised, frame.upsampled, seen.offsets, 0.7),
            alignment_loss(seen.tokens_3d, seen.tokens_depth, 1.3, 0.0, 0.05),
        )
        transport = {"lambda_transport": 0.6, "transport_epsilon": 0.07}
        whole = config.with_adapt(**transport).adapt
        aligned = (
            auxiliary_losses(frame, made, seen, whole)[-1],
            alignment_loss(seen.tokens_3d, seen.tokens_depth, 1.3, 0.6, 0.07),
        )
        return losses, jnp.stack(terms), gradient, aligned

    return evaluate


def test_it_is_the_weighted_sum_of_its_terms(evaluate, variables):
    """Eq. 11 and 13: softmax weights over the losses divided by their scales."""
    losses, terms, _, aligned = evaluate(*pop_encoders(variables))
    assert min(terms) > 0
    np.testing.assert_allclose(*aligned, rtol=1e-9)
    assert aligned[0] > terms[-1]
    found = [getattr(losses, name) for name in Losses._fields[1:]]
    np.testing.assert_allclose(found, terms, rtol=1e-9)
    weights = np.exp(LOGITS) / np.exp(LOGITS).sum()
    expected = LAMBDAS["depth_weight"] * terms[0]
    expected += weights @ (terms[1:] / np.array(SCALES))
    np.testing.assert_allclose(losses.objective, expected, rtol=1e-9)


@pytest.mark.parametrize("moving", ["point_encoder", "depth_encoder"])
def test_gradient_against_finite_differences(evaluate, variables, moving):
    encoders, rest = pop_encoders(variables)
    weighting = {**rest["weighting"], "logits": jnp.array(SMOOTH_LOGITS)}
    rest = {**rest, "weighting": weighting}
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda x: rng.normal(size=x.shape), encoders[moving])
    step = 1e-7

    def at(sign):
        tree = jax.tree.map(
            lambda p, d: p + sign * step * d, encoders[moving], direction
        )
        return evaluate({**encoders, moving: tree}, rest)[0].objective

    expected = dot(evaluate(encoders, rest)[2][moving], direction)
    assert abs(expected) > 0.01
    np.testing.assert_allclose((at(1) - at(-1)) / (2 * step), expected, rtol=1e-5)


def test_what_the_inner_loop_of_training_descends(minimal):
    """Eq. 11, or all of Eq. 13 where that is rehearsed."""
    config = minimal.config.with_adapt(depth_weight=2.0, auxiliary_weight=3.0)
    assert _descended(config, MetaConfig(rehearse_depth=True)) == config
    adapt = _descended(config, MetaConfig()).adapt
    assert (adapt.depth_weight, adapt.auxiliary_weight) == (0.0, 1.0)
