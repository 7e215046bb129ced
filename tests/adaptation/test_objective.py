"""The objective of Eq. 13, in double precision. `test_meta.py` has its gradient."""

import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.adaptation import meta
from prism_jax.adaptation.config import MetaConfig
from prism_jax.adaptation.objective import Losses
from prism_jax.adaptation.objective import test_time_objective as objective
from prism_jax.losses.alignment import alignment_loss
from prism_jax.losses.denoise import denoise_loss
from prism_jax.losses.depth import depth_supervised
from prism_jax.losses.normal import normal_loss
from prism_jax.models.prism import branches, prepare_input, read_depth
from tests.trees import as_double, row

LAMBDAS = {
    "lambda_smooth": 0.3,
    "lambda_offset": 0.7,
    "lambda_sigma": 1.3,
    "lambda_transport": 0.6,
    "transport_epsilon": 0.07,
    "depth_weight": 2.0,
}
LOGITS = (0.5, 0.3, -0.4)
SCALES = (0.5, 0.02, 7.0)


def test_it_is_the_weighted_sum_of_its_terms(
    minimal, minimal_variables, tiny_frames, quick_jit
):
    """Eq. 11 and 13: softmax weights over the losses divided by their scales."""
    config = minimal.config.with_adapt(**LAMBDAS)
    weighting = {"logits": jnp.array(LOGITS), "scales": jnp.array(SCALES)}
    variables = {**minimal_variables, "weighting": weighting}

    @quick_jit
    def evaluate(variables, partial, camera):
        key = jax.random.key(config.adapt.seed)
        frame = prepare_input(partial, camera, key, config.model)
        losses, made = objective(variables, frame, config)
        features = read_depth(variables, frame, config.model)
        seen = branches(variables, frame, made, features, config.model)
        neighbors, denoised = config.adapt.normal_neighbors, frame.perturbed
        terms = (
            depth_supervised(made.points, frame.partial, frame.view),
            normal_loss(seen.normals, made.points, 0.3, neighbors),
            denoise_loss(denoised + seen.offsets, frame.upsampled, seen.offsets, 0.7),
            alignment_loss(seen.tokens_3d, seen.tokens_depth, 1.3, 0.6, 0.07),
        )
        return losses, jnp.stack(terms)

    with jax.enable_x64(True):
        frame = row(as_double(tiny_frames), 0)
        losses, terms = jax.device_get(evaluate(as_double(variables), *frame))
    assert min(terms) > 0
    found = [getattr(losses, name) for name in Losses._fields[1:]]
    np.testing.assert_allclose(found, terms, rtol=1e-9)
    weights = np.exp(LOGITS) / np.exp(LOGITS).sum()
    expected = LAMBDAS["depth_weight"] * terms[0]
    expected += weights @ (terms[1:] / np.array(SCALES))
    np.testing.assert_allclose(losses.objective, expected, rtol=1e-7)


def test_what_the_inner_loop_of_training_descends(minimal, monkeypatch):
    """Eq. 11, or all of Eq. 13 where that is rehearsed."""
    config = minimal.config.with_adapt(depth_weight=2.0, auxiliary_weight=3.0)
    monkeypatch.setattr(meta, "test_time_objective", lambda *arguments: arguments[-1])

    def descended(method):
        return meta.network_functions(config, method).auxiliary_loss(None, None)

    assert descended(MetaConfig(rehearse_depth=True)) == config
    adapt = descended(MetaConfig()).adapt
    assert (adapt.depth_weight, adapt.auxiliary_weight) == (0.0, 1.0)
