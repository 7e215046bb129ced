"""Which gradient goes where, in every variation of Eq. 12, on a toy.

The toy has a few numbers a module, and smooth losses in the place of Eq. 3 to 10;
Eq. 11 is the real one. Everything is in double precision.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from prism_jax.adaptation.config import MetaConfig, PrismConfig
from prism_jax.adaptation.meta import Functions, MetaTerms, learned_part, meta_loss
from prism_jax.adaptation.objective import Losses
from prism_jax.losses.weighting import weighted_auxiliary
from prism_jax.models.variables import ENCODERS, pop_encoders, put_encoders
from tests.trees import assert_close, is_zero

CONFIG = PrismConfig().with_adapt(step_size=0.2, depth_weight=0.7)
CLOUDS, POINTS = 2, 6


@pytest.fixture(scope="module", autouse=True)
def double():
    with jax.enable_x64(True):
        yield


class Input(NamedTuple):
    partial: jax.Array
    view: jax.Array


class Prediction(NamedTuple):
    stages: tuple[jax.Array, ...]
    features: jax.Array


def encode(variables, inputs):
    point = variables["params"]["point_encoder"]
    return jnp.tanh(inputs.partial.mean(0) * point["first"] + point["second"] ** 2)


def decode(variables, inputs, code):
    """Of one cloud or several, as the network's."""
    decoder, spread = variables["params"]["decoder"]["only"], code[..., None, :]
    seeds = inputs.partial[..., :3, :] * decoder + spread
    last = (inputs.partial + spread) * jnp.cos(decoder)
    return Prediction((seeds, last), jnp.sin(inputs.partial + spread))


def refine(variables, prediction):
    own = variables["params"]["refiner"]["only"]
    return prediction.stages[-1] + 0.1 * jnp.tanh(own * prediction.features)


def objective(variables, inputs, depth_weight):
    code = encode(variables, inputs)
    prediction = decode(variables, inputs, code)
    points = refine(variables, prediction)
    weighting, params = variables["weighting"], variables["params"]
    depth = jnp.sin(params["depth_encoder"]["only"])
    branch = params["auxiliary"]["only"]
    consistency = ((points - inputs.partial) ** 2).mean()
    normal = (jnp.sin(code * branch) ** 2).sum() + (points**2).mean()
    terms = [normal, ((code - depth) ** 2).sum(), ((branch * code * depth) ** 2).sum()]
    auxiliary, scales = jnp.stack(terms), weighting["scales"]
    weighted = weighted_auxiliary(weighting["logits"], auxiliary, scales)
    total = depth_weight * consistency + weighted
    return Losses(total, consistency, *terms), prediction


def primary_loss(stages, complete, norm):
    """Point by point, unsquared or squared."""
    squares = [((s - complete[: len(s)]) ** 2).sum(-1) for s in stages]
    return sum(jnp.mean(s if norm == "l2" else jnp.sqrt(s)) for s in squares)


def depth_loss(points, complete, view):
    return ((points - view * complete[: len(points)]) ** 2).mean()


def depth_weight(config, meta):
    return config.adapt.depth_weight if meta.rehearse_depth else 0.0


def found(variables, inputs, complete, config, meta):
    """Gradients and terms of the meta-loss."""

    def refiner_loss(variables, after, inputs, complete):
        points = refine(variables, after)
        return jax.vmap(depth_loss)(points, complete, inputs.view).mean()

    functions = Functions(
        encode,
        decode,
        lambda variables, one: objective(variables, one, depth_weight(config, meta)),
        lambda stages, complete: primary_loss(stages, complete, meta.norm),
        refiner_loss,
    )
    learned, batch = learned_part(variables, meta), (variables, inputs, complete)
    gradient = jax.grad(meta_loss, has_aux=True)
    return gradient(learned, *batch, functions, config.adapt, meta)


def with_params(variables, **changes):
    return {**variables, "params": {**variables["params"], **changes}}


def descended(variables, slope, config):
    """One step of every module of the encoders, of the size that it learned."""
    encoders, rest = pop_encoders(variables)
    norm = sum((leaf**2).sum() for leaf in jax.tree.leaves(slope)) ** 0.5
    bound, size = config.adapt.clip_norm, config.adapt.step_size
    size = size * jnp.minimum(1.0, bound / norm) if bound else size
    learned = variables["weighting"]["log_steps"]
    moved = jax.tree.map(
        lambda p, g, s: p - size * jnp.exp(s) * g, encoders, slope, learned
    )
    return put_encoders(moved, rest)


def expected(variables, inputs, complete, config, meta):
    """The same, each gradient by an objective of its own, cloud by cloud."""

    def inner(encoders, variables, one):
        whole = put_encoders(encoders, pop_encoders(variables)[1])
        losses, _ = objective(whole, one, depth_weight(config, meta))
        return losses.objective

    def adapted(variables, one):
        for _ in range(meta.num_steps):
            encoders, _ = pop_encoders(variables)
            slope = jax.grad(inner)(encoders, variables, one)
            if meta.first_order:
                slope = jax.lax.stop_gradient(slope)
            variables = descended(variables, slope, config)
        return variables

    def of_cloud(one, complete):
        def primary(variables):
            stages = decode(variables, one, encode(variables, one)).stages
            return primary_loss(stages, complete, meta.norm)

        def eq_12(variables):
            """Without its auxiliary term. The decoder has no part in the inner loop's
            derivative, nor in the zero-step term's."""
            decoder, held = variables["params"]["decoder"], variables
            if meta.num_steps:
                held = with_params(variables, decoder=jax.lax.stop_gradient(decoder))
            end = with_params(adapted(held, one), decoder=decoder)
            return (1 - meta.beta_0) * primary(end) + meta.beta_0 * primary(held)

        def eq_3(refiner):
            end = with_params(moved, refiner=refiner)
            points = refine(end, decode(end, one, encode(end, one)))
            return depth_loss(points, complete, one.view)

        encoders, _ = pop_encoders(variables)
        moved = adapted(variables, one)
        refined, by_refiner = jax.value_and_grad(eq_3)(variables["params"]["refiner"])
        losses, _ = objective(variables, one, depth_weight(config, meta))
        terms = MetaTerms(primary(moved), primary(variables), losses, refined)
        slope = jax.grad(inner)(encoders, variables, one)
        return terms, jax.grad(eq_12)(variables), by_refiner, slope

    each = jax.vmap(of_cloud)(inputs, complete)
    terms, whole, by_refiner, slope = jax.tree.map(lambda leaf: leaf.mean(0), each)
    factor = (1 - meta.beta_0) * meta.lambda_aux
    names = [*ENCODERS, "decoder", *(["auxiliary"] if meta.learn_auxiliary else [])]
    params = {name: whole["params"][name] for name in names}
    for name in ENCODERS:
        add = zip(params[name].items(), slope[name].values(), strict=True)
        params[name] = {key: g + factor * a for (key, g), a in add}
    if meta.learn_refiner:
        params["refiner"] = by_refiner
    own, weighting = variables["weighting"], {"logits": whole["weighting"]["logits"]}
    if meta.weight_rule == "auxiliary":
        # d/d eta of sum softmax(eta) l / s = w (l / s - sum w l / s).
        weights = jnp.exp(own["logits"]) / jnp.exp(own["logits"]).sum()
        scaled = terms.losses.auxiliary / own["scales"]
        weighting["logits"] = weights * (scaled - weights @ scaled)
    if meta.learn_steps:
        weighting["log_steps"] = whole["weighting"]["log_steps"]
    return {"params": params, "weighting": weighting}, terms


@pytest.fixture(scope="module")
def toy(double):
    """Variables, inputs and complete clouds."""
    rng = np.random.default_rng(3)

    def numbers(*shape):
        return jnp.asarray(rng.uniform(0.4, 1.2, shape))

    params = {
        "point_encoder": {"first": numbers(3), "second": numbers(3)},
        "depth_encoder": {"only": numbers(3)},
        "decoder": {"only": numbers(3)},
        "refiner": {"only": numbers(3)},
        "auxiliary": {"only": numbers(3)},
    }
    steps = {name: {module: numbers() for module in params[name]} for name in ENCODERS}
    weighting = {"logits": numbers(3), "scales": numbers(3), "log_steps": steps}
    inputs = Input(numbers(CLOUDS, POINTS, 3), numbers(CLOUDS))
    variables = {"params": params, "batch_stats": {}, "weighting": weighting}
    return variables, inputs, numbers(CLOUDS, 9, 3)


# Every choice is made one way and the other; what learns and what is bounded too.
EVERYTHING = {"weight_rule": "meta", "learn_steps": True, "learn_auxiliary": True}
OTHERWISE = {"beta_0": 0.4, "lambda_aux": 3.0, "rehearse_depth": True, "norm": "l2"}
BOUNDED = {**EVERYTHING, **OTHERWISE, "learn_refiner": False, "remat": True}
VARIATIONS = {
    "paper": (0.0, MetaConfig()),
    "all that learns, two bounded steps": (0.3, MetaConfig(num_steps=2, **BOUNDED)),
    "no step": (0.0, MetaConfig(num_steps=0, weight_rule="meta", lambda_aux=3.0)),
    "first order": (0.0, MetaConfig(num_steps=2, first_order=True, **EVERYTHING)),
}


@pytest.mark.parametrize(("clip_norm", "meta"), VARIATIONS.values(), ids=VARIATIONS)
def test_every_gradient_is_that_of_its_own_objective(toy, clip_norm, meta):
    """And there is one for what learns, and for nothing else. Terms alike."""
    settings = CONFIG.with_adapt(clip_norm=clip_norm), meta
    both = jax.jit(lambda *toy: (found(*toy, *settings), expected(*toy, *settings)))
    (gradients, terms), by_hand = both(*toy)
    assert_close(gradients, by_hand[0], 1e-10)
    assert_close(terms, by_hand[1], 1e-12)
    # What acts through the second derivatives alone, of which there may be none.
    through = not meta.first_order and meta.num_steps > 0
    if meta.weight_rule == "meta":
        assert is_zero(gradients["weighting"]["logits"]) != through
    if meta.learn_auxiliary:
        assert is_zero(gradients["params"]["auxiliary"]) != through
