"""Which gradient goes where, in every variation of Eq. 12, on a toy."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.config import MetaConfig
from prism_jax.adaptation.meta import (
    Functions,
    MetaTerms,
    learned_part,
    meta_loss,
    put_learned,
)
from prism_jax.adaptation.objective import Losses
from prism_jax.losses.weighting import update_scale
from tests.toy_functions import (
    CLOUDS,
    TOY,
    eq_3,
    expected_gradients,
    gradients_of_toys,
    toy_adapted,
    toy_inputs,
    toy_objective,
    toy_primary,
)
from tests.trees import assert_close, equal, is_zero, mean, row


class Stages(NamedTuple):
    stages: jax.Array


@pytest.fixture(scope="module", autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def toy(double):
    return toy_inputs()


@pytest.fixture(scope="module")
def toy_gradients(toy):
    """``toy_gradients(clip_norm, **changes of MetaConfig)``: gradients and terms."""

    @functools.cache
    def of(config, meta):
        return jax.device_get(gradients_of_toys(*toy, config, meta))

    def gradients(clip_norm=0.0, **changes):
        return of(TOY.with_adapt(clip_norm=clip_norm), MetaConfig(**changes))

    return gradients


# Every choice is made one way and the other; what learns and what is bounded too.
VARIATIONS = {
    "paper": {},
    "all that learns, three bounded steps": {
        "num_steps": 3,
        "beta_0": 0.4,
        "lambda_aux": 3.0,
        "weight_rule": "meta",
        "rehearse_depth": True,
        "learn_steps": True,
        "learn_auxiliary": True,
        "learn_refiner": False,
        "norm": "l2",
        "clip_norm": 0.3,
    },
    "no step": {"num_steps": 0, "weight_rule": "meta", "lambda_aux": 3.0},
    "first order": {
        "first_order": True,
        "num_steps": 3,
        "weight_rule": "meta",
        "learn_steps": True,
        "learn_auxiliary": True,
    },
}


def test_on_a_quadratic_it_is_the_closed_form():
    """The encoder x seeks t, the decoder is a factor d, the complete cloud is y."""
    x, t, d, y, size, beta, factor = 0.7, 1.9, 1.3, 2.2, 0.25, 0.3, 5.0

    def auxiliary_loss(variables, inputs):
        x = variables["params"]["point_encoder"]["x"]
        seeks, none = 0.5 * (x - inputs) ** 2, jnp.zeros(())
        return Losses(seeks, none, none, none, none), decode(variables, inputs, x)

    def decode(variables, inputs, code):
        return Stages(code * variables["params"]["decoder"])

    functions = Functions(
        lambda variables, inputs: variables["params"]["point_encoder"]["x"],
        decode,
        auxiliary_loss,
        lambda stages, complete: 0.5 * ((stages - complete) ** 2).mean(),
        lambda variables, after, inputs, complete: jnp.zeros(()),
    )
    encoders = {"point_encoder": {"x": jnp.array(x)}, "depth_encoder": {}}
    variables = {
        "params": {**encoders, "decoder": jnp.array(d)},
        "weighting": {
            "logits": jnp.zeros(3),
            "scales": jnp.zeros(3),
            "log_steps": {"point_encoder": {"x": jnp.zeros(())}, "depth_encoder": {}},
        },
    }
    meta = MetaConfig(beta_0=beta, lambda_aux=factor, learn_refiner=False)
    learned, complete = learned_part(variables, meta), jnp.full((1, 1, 3), y)
    adapt = dataclasses.replace(TOY.adapt, step_size=size)
    grads, terms = jax.grad(meta_loss, has_aux=True)(
        learned, variables, jnp.array([t]), complete, functions, adapt, meta
    )
    moved = x - size * (x - t)
    np.testing.assert_allclose(terms.adapted, 0.5 * (d * moved - y) ** 2, rtol=1e-12)
    slope = (1 - beta) * (d * (d * moved - y) * (1 - size) + factor * (x - t))
    slope += beta * d * (d * x - y)
    found = grads["params"]["point_encoder"]["x"]
    np.testing.assert_allclose(found, slope, rtol=1e-12)
    slope = (1 - beta) * moved * (d * moved - y)
    np.testing.assert_allclose(grads["params"]["decoder"], slope, rtol=1e-12)


@pytest.mark.parametrize("changes", VARIATIONS.values(), ids=VARIATIONS)
def test_every_gradient_is_that_of_its_own_objective(toy, toy_gradients, changes):
    """And there is one for what learns, and for nothing else."""
    grads, _ = toy_gradients(**changes)
    changes = dict(changes)
    config = TOY.with_adapt(clip_norm=changes.pop("clip_norm", 0.0))
    meta = MetaConfig(**changes)
    assert_close(grads, expected_gradients(toy, config, meta), 1e-10)
    # What acts through the second derivatives alone, of which there may be none.
    through = not meta.first_order and meta.num_steps > 0
    if meta.weight_rule == "meta":
        assert is_zero(grads["weighting"]["logits"]) != through
    assert meta.lambda_aux or is_zero(grads["params"]["depth_encoder"]) != through
    if meta.learn_auxiliary:
        assert is_zero(grads["params"]["auxiliary"]) != through
    # Put back, what was learned changes nothing else.
    variables, *_ = toy
    learned = learned_part(variables, meta)
    assert jax.tree.structure(grads) == jax.tree.structure(learned)
    moved = jax.tree.map(lambda leaf: leaf + 1, learned)
    together = put_learned(moved, variables)
    assert equal(learned_part(together, meta), moved)
    assert equal(put_learned(learned, together), variables)


def test_computed_anew_in_the_backward_pass_they_are_the_same(toy_gradients):
    plain = toy_gradients()
    assert_close(toy_gradients(remat=True), plain, 1e-12)


def test_terms_of_the_toy(toy, toy_gradients):
    variables, inputs, complete = toy
    changes = dict(VARIATIONS["all that learns, three bounded steps"])
    bounded = TOY.with_adapt(clip_norm=changes["clip_norm"])
    _, terms = toy_gradients(**changes)
    config = MetaConfig(**{k: v for k, v in changes.items() if k != "clip_norm"})

    def of_cloud(one, complete):
        end = toy_adapted(variables, one, bounded, config)
        refiner = variables["params"]["refiner"]
        return MetaTerms(
            toy_primary(end, one, complete, config),
            toy_primary(variables, one, complete, config),
            toy_objective(variables, one, TOY.adapt.depth_weight)[0],
            eq_3(refiner, variables, one, complete, bounded, config),
        )

    parts = [of_cloud(row(inputs, i), complete[i]) for i in range(CLOUDS)]
    assert_close(terms, mean(parts), 1e-12)


def test_scales_move_towards_what_was_measured(toy_gradients):
    _, terms = toy_gradients()
    losses = terms.losses.normal, terms.losses.denoise, terms.losses.align
    scales = np.array([0.0, 2.0, 3.0])
    found = update_scale(jnp.asarray(scales), terms.losses.auxiliary)
    expected = 0.99 * scales + 0.01 * np.array(losses)
    expected[0] = losses[0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
