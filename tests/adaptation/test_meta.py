"""The meta-objective, Eq. 12, in double precision, against finite differences on the
smallest network."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.config import MetaConfig
from prism_jax.adaptation.meta import meta_gradients
from prism_jax.adaptation.objective import test_time_objective as objective
from prism_jax.losses.depth import depth_supervised
from prism_jax.losses.primary import primary_loss
from prism_jax.models.prism import hold_decoding, predict, prepare_input
from prism_jax.models.variables import ENCODERS, pop_encoders, put_encoders
from tests.trees import as_double, assert_close, dot, is_zero, mean, row

pytestmark = pytest.mark.slow

FRAMES = 2


@pytest.fixture(scope="module", autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def by_hand(encoders, gradient, variables, adapt):
    """One bounded step of every module with the size that it learned."""
    learned = variables["weighting"]["log_steps"]
    share = min(1.0, adapt.clip_norm / dot(gradient, gradient) ** 0.5)

    def moved(name, module):
        size = adapt.step_size * share * np.exp(learned[name][module])
        own, slope = encoders[name][module], gradient[name][module]
        return jax.tree.map(lambda p, g: p - size * g, own, slope)

    return {
        name: {key: moved(name, key) for key in encoders[name]} for name in ENCODERS
    }


# Gradients stop at the PCA anchors of the normals and at the scale of the transport's
# entropy, which finite differences see move: neither has a weight here.
LOGITS, SCALES = (-1e9, 0.3, -0.4), (0.5, 0.02, 7.0)
SMOOTH = {"lambda_transport": 0.0, "depth_weight": 2.0, "step_size": 0.01}
SMOOTH |= {"clip_norm": 1.0}
BETA, LAMBDA = 0.3, 10.0


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.config.with_adapt(**SMOOTH)


@pytest.fixture(scope="module")
def frames(config, variables, tiny_frames, quick_jit, double):
    """Their decoding held, as an episode holds it."""

    @quick_jit
    def prepare(partial, camera):
        key = jax.random.key(config.adapt.seed)
        frame = prepare_input(partial, camera, key, config.model)
        return hold_decoding(variables, frame, config.model)

    made = [prepare(*row(as_double(tiny_frames), i)) for i in range(FRAMES)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)


@pytest.fixture(scope="module")
def complete(double):
    clouds = np.random.default_rng(2).uniform(-0.8, 0.8, (FRAMES, 96, 3))
    return jnp.asarray(clouds)


@pytest.fixture(scope="module")
def variables(minimal_variables, double):
    """Not fresh ones: their biases of zero leave many a ReLU exactly at its kink."""
    weighting = {
        "logits": jnp.array(LOGITS),
        "scales": jnp.array(SCALES),
        "log_steps": minimal_variables["weighting"]["log_steps"],
    }
    return as_double({**minimal_variables, "weighting": weighting})


@pytest.fixture(scope="module")
def look(config, frames, complete, quick_jit):
    """``look(variables, i)``: all that frame i tells to first order."""

    @quick_jit
    def compiled(variables, frame, complete):
        encoders, rest = pop_encoders(variables)
        refiner = variables["params"]["refiner"]

        def inner(encoders):
            losses, _ = objective(put_encoders(encoders, rest), frame, config)
            return losses.objective, losses

        def with_params(changed):
            return {**variables, "params": {**variables["params"], **changed}}

        def primary(moving):
            made = predict(with_params(moving), frame, config.model)
            return primary_loss(made.stages, complete, "l1")

        def refined(refiner):
            made = predict(with_params({"refiner": refiner}), frame, config.model)
            return depth_supervised(made.points, complete, frame.view)

        moving = {**encoders, "decoder": variables["params"]["decoder"]}
        (_, losses), descent = jax.value_and_grad(inner, has_aux=True)(encoders)
        value, by_primary = jax.value_and_grad(primary)(moving)
        error, by_refined = jax.value_and_grad(refined)(refiner)
        return {
            "losses": losses,
            "descent": descent,
            "primary": value,
            "by_primary": by_primary,
            "refined": error,
            "by_refined": by_refined,
        }

    def seen(variables, i):
        found = compiled(variables, row(frames, i), complete[i])
        return types.SimpleNamespace(**jax.device_get(found))

    return seen


def one_step(look, variables, i, config):
    """The variables with the encoders that frame i adapts."""
    encoders, rest = pop_encoders(variables)
    descent = look(variables, i).descent
    return put_encoders(by_hand(encoders, descent, variables, config.adapt), rest)


@pytest.fixture(scope="module")
def second_order(config, variables, frames, complete, quick_jit):
    """Gradients and terms where everything that can learn does, through one rehearsed
    step."""
    meta = MetaConfig(
        beta_0=BETA,
        lambda_aux=LAMBDA,
        weight_rule="meta",
        rehearse_depth=True,
        learn_steps=True,
        learn_auxiliary=True,
    )
    run = quick_jit(lambda v, f, c: meta_gradients(v, f, c, config, meta))
    return jax.device_get(run(variables, frames, complete))


@pytest.fixture(scope="module")
def before(look, variables):
    return [look(variables, i) for i in range(FRAMES)]


@pytest.fixture(scope="module")
def after(look, variables, config):
    """What the adapted encoders see."""
    moved = [one_step(look, variables, i, config) for i in range(FRAMES)]
    return [look(moved[i], i) for i in range(FRAMES)]


def test_terms_are_those_before_and_after_the_step(second_order, before, after):
    _, terms = second_order
    assert_close(terms.adapted, np.mean([seen.primary for seen in after]), 1e-11)
    assert_close(terms.zero_step, np.mean([seen.primary for seen in before]), 1e-11)
    assert_close(terms.refined, np.mean([seen.refined for seen in after]), 1e-10)
    assert_close(terms.losses, mean([seen.losses for seen in before]), 1e-11)
    assert abs(terms.adapted - terms.zero_step) > 1e-5


# What acts through the inner loop alone moves little, and far from any kink.
STEPS = {"point_encoder": 1e-8, "decoder": 1e-8, "depth_encoder": 1e-6}
STEPS |= {"logits": 1e-5, "log_steps": 1e-5, "auxiliary": 1e-6}
MOVING = tuple(STEPS)


@pytest.fixture(scope="module")
def differences(look, variables, config):
    """``differences(name)``: a random direction in a part of the variables, and the
    slope of the primary terms of Eq. 12 along it, by finite differences.

    The decoder moves where the adapted encoders are decoded, and nowhere else.
    """

    def value(moved, decodes):
        total = 0.0
        for i in range(FRAMES):
            encoders = one_step(look, moved, i, config)["params"]
            params = {**decodes["params"], **{n: encoders[n] for n in ENCODERS}}
            end = look({**decodes, "params": params}, i).primary
            total += (1 - BETA) * end + BETA * look(moved, i).primary
        return total / FRAMES

    def differences(name):
        rng = np.random.default_rng(MOVING.index(name))
        kind = "weighting" if name in variables["weighting"] else "params"
        step = STEPS[name]
        direction = jax.tree.map(
            lambda leaf: rng.normal(size=leaf.shape), variables[kind][name]
        )

        def at(sign):
            tree = jax.tree.map(
                lambda p, d: p + sign * step * d, variables[kind][name], direction
            )
            moved = {**variables, kind: {**variables[kind], name: tree}}
            return value(variables if name == "decoder" else moved, moved)

        return direction, (at(1) - at(-1)) / (2 * step)

    return differences


@pytest.mark.parametrize("name", MOVING)
def test_gradients_against_finite_differences(
    second_order, differences, before, after, name
):
    """Of the primary terms; L_aux's own share of the encoders' is known exactly."""
    grads, _ = second_order
    direction, slope = differences(name)
    kind = "weighting" if name in grads["weighting"] else "params"
    found = dot(grads[kind][name], direction)
    first_order = 0.0
    if name in ENCODERS:
        shares = [dot(seen.descent[name], direction) for seen in before]
        found -= (1 - BETA) * LAMBDA * np.mean(shares)
        first_order = np.mean(
            [
                (1 - BETA) * dot(end.by_primary[name], direction)
                + BETA * dot(start.by_primary[name], direction)
                for start, end in zip(before, after, strict=True)
            ]
        )
    np.testing.assert_allclose(slope, found, rtol=1e-5)
    if name != "decoder":
        # A first-order gradient would not have passed.
        assert abs(slope - first_order) > 1e-3 * abs(slope) > 0


def test_decoder_learns_from_the_adapted_encoders_alone(second_order, after):
    grads, _ = second_order
    expected = mean([seen.by_primary["decoder"] for seen in after])
    expected = jax.tree.map(lambda g: (1 - BETA) * g, expected)
    assert_close(grads["params"]["decoder"], expected, 1e-9)


def test_refiner_learns_from_eq_3_of_the_adapted_completion(second_order, after):
    grads, _ = second_order
    expected = mean([seen.by_refined for seen in after])
    assert_close(grads["params"]["refiner"], expected, 1e-9)
    assert not is_zero(expected)
