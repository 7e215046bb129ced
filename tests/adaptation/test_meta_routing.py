"""Which gradient goes where, in every variation of Eq. 12, on a toy."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.config import MetaConfig
from prism_jax.adaptation.inner_loop import step_sizes
from prism_jax.adaptation.meta import (
    Functions,
    MetaTerms,
    learned_part,
    measured_scales,
    meta_loss,
    put_learned,
)
from prism_jax.adaptation.objective import Losses
from prism_jax.models.variables import ENCODERS, pop_encoders
from tests.toy_functions import (
    CLOUDS,
    TOY,
    eq_3,
    expected_gradients,
    gradients_of_toys,
    inner_loss,
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


SMALL = {
    "lambda_aux": 0.0,
    "weight_rule": "meta",
    "rehearse_depth": True,
    "learn_steps": True,
    "learn_auxiliary": True,
    "learn_refiner": False,
}
VARIATIONS = {
    "paper": {},
    "small": SMALL,
    "three steps": {"num_steps": 3, "beta_0": 0.4, "learn_steps": True},
    "small, three steps": SMALL | {"num_steps": 3},
    "small, with an auxiliary loss": SMALL | {"lambda_aux": 3.0},
    "no step": {"num_steps": 0},
    "no step, rehearsed": SMALL | {"num_steps": 0, "lambda_aux": 3.0},
    "first order": {"first_order": True, "weight_rule": "meta", "learn_steps": True},
    "first order, three steps": SMALL | {"first_order": True, "num_steps": 3},
    "squared distances": {"norm": "l2", "rehearse_depth": True},
    "bounded": {"clip_norm": 0.3, "learn_steps": True},
    "bounded, three steps": SMALL | {"clip_norm": 0.3, "num_steps": 3},
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
    grads, _ = toy_gradients(**changes)
    changes = dict(changes)
    config = TOY.with_adapt(clip_norm=changes.pop("clip_norm", 0.0))
    expected = expected_gradients(toy, config, MetaConfig(**changes))
    assert_close(grads, expected, 1e-10)


@pytest.mark.parametrize("num_steps", [0, 1, 3])
def test_computed_anew_in_the_backward_pass_they_are_the_same(toy_gradients, num_steps):
    plain = toy_gradients(num_steps=num_steps, learn_steps=True)
    anew = toy_gradients(num_steps=num_steps, learn_steps=True, remat=True)
    assert_close(anew, plain, 1e-12)


@pytest.mark.parametrize("first_order", [False, True])
@pytest.mark.parametrize("num_steps", [0, 1, 3])
def test_what_the_auxiliary_loss_teaches(toy, toy_gradients, num_steps, first_order):
    """The encoders its own gradient at the start, whatever the steps; no one else."""
    same = {"num_steps": num_steps, "first_order": first_order, "weight_rule": "meta"}
    none, _ = toy_gradients(lambda_aux=0.0, **same)
    ten, _ = toy_gradients(lambda_aux=10.0, **same)
    variables, inputs, _ = toy
    encoders, _ = pop_encoders(variables)
    shares = mean(
        [
            jax.grad(inner_loss)(encoders, variables, row(inputs, i), TOY, MetaConfig())
            for i in range(CLOUDS)
        ]
    )
    for name in ENCODERS:
        expected = jax.tree.map(
            lambda g, a: g + 0.9 * 10.0 * a, none["params"][name], shares[name]
        )
        assert_close(ten["params"][name], expected, 1e-12)
        assert not is_zero(shares[name])
    for name in ("decoder", "refiner"):
        assert equal(none["params"][name], ten["params"][name]), name
    assert equal(none["weighting"], ten["weighting"])


def test_eq_3_teaches_the_refiner_alone(toy, toy_gradients):
    """Where Eq. 3 is another, or nothing learns from it, the others' are the same."""
    with_it, terms = toy_gradients()
    without, _ = toy_gradients(learn_refiner=False)
    assert set(without["params"]) == {*ENCODERS, "decoder"}
    assert equal(
        {**with_it["params"], "refiner": None}, {**without["params"], "refiner": None}
    )
    assert equal(with_it["weighting"], without["weighting"])
    variables, inputs, complete = toy
    other = inputs._replace(view=2.0 * inputs.view)
    moved, others = gradients_of_toys(variables, other, complete, TOY, MetaConfig())
    for name in (*ENCODERS, "decoder"):
        assert_close(moved["params"][name], with_it["params"][name], 1e-12)
    assert abs(others.refined - terms.refined) > 0.01
    assert not np.allclose(
        moved["params"]["refiner"]["only"], with_it["params"]["refiner"]["only"]
    )


def test_the_refiner_sees_the_adapted_completion(toy_gradients):
    zero, _ = toy_gradients(num_steps=0)
    three, _ = toy_gradients(num_steps=3)
    there = zero["params"]["refiner"]["only"], three["params"]["refiner"]["only"]
    assert not np.allclose(*there, rtol=1e-3)


def test_meta_weights_need_the_second_order(toy_gradients):
    """And Eq. 11's own do not: they follow from the losses as they are."""
    meta_rule, _ = toy_gradients(weight_rule="meta")
    first, _ = toy_gradients(weight_rule="meta", first_order=True)
    own, _ = toy_gradients()
    own_first, _ = toy_gradients(first_order=True)
    none, _ = toy_gradients(weight_rule="meta", num_steps=0)
    logits = [
        grads["weighting"]["logits"]
        for grads in (meta_rule, first, own, own_first, none)
    ]
    assert np.abs(logits[0]).max() > 1e-4
    assert is_zero(logits[1])
    assert is_zero(logits[4])
    assert not np.allclose(logits[0], logits[2], rtol=0.1)
    np.testing.assert_allclose(logits[2], logits[3], rtol=1e-12)
    # Softmax weights know their logits up to a constant.
    for each in (logits[0], logits[2]):
        assert abs(each.sum()) < 1e-12


def test_step_sizes_learn_in_either_order_but_not_alike(toy_gradients):
    """After one step alike: its size scales a gradient that both know. The depth
    stream's has an effect from the second on, and to second order alone."""
    for num_steps in (1, 3):
        same = {"learn_steps": True, "num_steps": num_steps}
        second, _ = toy_gradients(**same)
        first, _ = toy_gradients(first_order=True, **same)
        steps = [grads["weighting"]["log_steps"] for grads in (first, second)]
        points = [list(each["point_encoder"].values()) for each in steps]
        assert np.abs(points).min() > 1e-3
        assert np.allclose(*points, rtol=1e-9) == (num_steps == 1)
        assert is_zero(steps[0]["depth_encoder"])
        assert is_zero(steps[1]["depth_encoder"]) == (num_steps == 1)
    without, _ = toy_gradients()
    assert "log_steps" not in without["weighting"]


def test_the_depth_stream_learns_through_the_inner_loop_alone(toy_gradients):
    """It decodes nothing: to first order the primary losses do not see it."""
    second, _ = toy_gradients(lambda_aux=0.0)
    first, _ = toy_gradients(lambda_aux=0.0, first_order=True)
    assert not is_zero(second["params"]["depth_encoder"])
    assert is_zero(first["params"]["depth_encoder"])
    assert not is_zero(first["params"]["point_encoder"])


def test_terms_of_the_toy(toy, toy_gradients):
    variables, inputs, complete = toy
    config = MetaConfig(num_steps=3, rehearse_depth=True)
    _, terms = toy_gradients(num_steps=3, rehearse_depth=True)

    def of_cloud(one, complete):
        end = toy_adapted(variables, one, TOY, config)
        refiner = variables["params"]["refiner"]
        return MetaTerms(
            toy_primary(end, one, complete, config),
            toy_primary(variables, one, complete, config),
            toy_objective(variables, one, TOY.adapt.depth_weight)[0],
            eq_3(refiner, variables, one, complete, TOY, config),
        )

    parts = [of_cloud(row(inputs, i), complete[i]) for i in range(CLOUDS)]
    assert_close(terms, mean(parts), 1e-12)


def test_the_objective_is_what_the_inner_loop_descends(toy_gradients):
    _, plain = toy_gradients()
    _, rehearsed = toy_gradients(rehearse_depth=True)
    assert plain.losses.depth_consistency == rehearsed.losses.depth_consistency > 0
    extra = rehearsed.losses.objective - plain.losses.objective
    expected = TOY.adapt.depth_weight * plain.losses.depth_consistency
    np.testing.assert_allclose(extra, expected, rtol=1e-12)


@pytest.mark.parametrize("learn_refiner", [False, True])
@pytest.mark.parametrize("learn_steps", [False, True])
def test_gradients_are_for_what_learns(toy, toy_gradients, learn_steps, learn_refiner):
    variables, *_ = toy
    changes = {"learn_steps": learn_steps, "learn_refiner": learn_refiner}
    grads, _ = toy_gradients(**changes)
    learned = learned_part(variables, MetaConfig(**changes))
    assert jax.tree.structure(grads) == jax.tree.structure(learned)
    kept = {*ENCODERS, "decoder"} | ({"refiner"} if learn_refiner else set())
    assert set(learned["params"]) == kept
    assert set(learned["weighting"]) == {"logits"} | (
        {"log_steps"} if learn_steps else set()
    )


def test_what_was_learned_goes_back_to_its_place(toy):
    variables, *_ = toy
    for changes in ({}, SMALL):
        learned = learned_part(variables, MetaConfig(**changes))
        moved = jax.tree.map(lambda leaf: leaf + 1, learned)
        together = put_learned(moved, variables)
        assert jax.tree.structure(together) == jax.tree.structure(variables)
        assert equal(learned_part(together, MetaConfig(**changes)), moved)
        back = put_learned(learned, together)
        assert equal(back, variables)


def test_scales_move_towards_what_was_measured(toy, toy_gradients):
    variables, *_ = toy
    _, terms = toy_gradients()
    losses = terms.losses.normal, terms.losses.denoise, terms.losses.align
    scales = np.array([0.0, 2.0, 3.0])
    weighting = {**variables["weighting"], "scales": jnp.asarray(scales)}
    found = measured_scales({**variables, "weighting": weighting}, terms)
    expected = 0.99 * scales + 0.01 * np.array(losses)
    expected[0] = losses[0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_held_norms_have_no_step_to_learn(toy):
    """Their step is none, whatever was learned for their module."""
    variables, *_ = toy
    params = variables["params"]
    normed = {"kernel": jnp.ones(2), "norm": {"scale": jnp.ones(2)}}
    params = {**params, "depth_encoder": {"only": normed}}
    variables = {**variables, "params": params}
    held = dataclasses.replace(TOY.adapt, adapt_norm=False)

    def reached(steps):
        weighting = {**variables["weighting"], "log_steps": steps}
        sizes = step_sizes({**variables, "weighting": weighting}, held)
        return sizes["depth_encoder"]["only"]

    jacobian = jax.jacobian(reached)(variables["weighting"]["log_steps"])
    assert is_zero(jacobian["norm"])
    own = jacobian["kernel"]["depth_encoder"]["only"]
    expected = 0.2 * np.exp(
        variables["weighting"]["log_steps"]["depth_encoder"]["only"]
    )
    np.testing.assert_allclose(own, expected, rtol=1e-12)
