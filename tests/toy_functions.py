"""Toy functions for Eq. 12, in the place of the networks and losses.

A few numbers a module, and smooth losses in the place of Eq. 3 to 10; Eq. 11 is the
real one. What Eq. 12 asks of them is written out here as functions of all variables.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.meta import Functions, learned_part, meta_loss
from prism_jax.adaptation.objective import Losses
from prism_jax.losses.weighting import weighted_auxiliary
from prism_jax.models.variables import ENCODERS, pop_encoders, put_encoders
from tests.trees import mean, row

TOY = PrismConfig().with_adapt(step_size=0.2, depth_weight=0.7)
CLOUDS, POINTS = 2, 6


class ToyInput(NamedTuple):
    partial: jax.Array
    view: jax.Array


class ToyPrediction(NamedTuple):
    stages: tuple[jax.Array, jax.Array]
    features: jax.Array


def toy_encode(variables, inputs):
    point = variables["params"]["point_encoder"]
    return jnp.tanh(inputs.partial.mean(0) * point["first"] + point["second"] ** 2)


def toy_decode(variables, inputs, code):
    """Of one cloud or several, as the network's."""
    decoder, spread = variables["params"]["decoder"]["only"], code[..., None, :]
    seeds = inputs.partial[..., :3, :] * decoder + spread
    last = (inputs.partial + spread) * jnp.cos(decoder)
    return ToyPrediction((seeds, last), jnp.sin(inputs.partial + spread))


def toy_predict(variables, inputs):
    return toy_decode(variables, inputs, toy_encode(variables, inputs))


def toy_refine(variables, prediction):
    own = variables["params"]["refiner"]["only"]
    return prediction.stages[-1] + 0.1 * jnp.tanh(own * prediction.features)


def toy_objective(variables, inputs, depth_weight):
    code = toy_encode(variables, inputs)
    prediction = toy_decode(variables, inputs, code)
    points = toy_refine(variables, prediction)
    weighting = variables["weighting"]
    depth = jnp.sin(variables["params"]["depth_encoder"]["only"])
    branch = variables["params"]["auxiliary"]["only"]
    consistency = ((points - inputs.partial) ** 2).mean()
    terms = jnp.stack(
        [
            (jnp.sin(code * branch) ** 2).sum() + (points**2).mean(),
            ((code - depth) ** 2).sum(),
            ((branch * code * depth) ** 2).sum(),
        ]
    )
    weighted = weighted_auxiliary(weighting["logits"], terms, weighting["scales"])
    objective = depth_weight * consistency + weighted
    return Losses(objective, consistency, *terms), prediction


def toy_loss(stages, complete, norm):
    """Point by point, unsquared or squared."""
    squares = [((s - complete[: len(s)]) ** 2).sum(-1) for s in stages]
    return sum(jnp.mean(s if norm == "l2" else jnp.sqrt(s)) for s in squares)


def toy_depth(predicted, complete, view):
    return ((predicted - view * complete[: len(predicted)]) ** 2).mean()


def toy_functions(config, meta):
    """What `prism_jax.adaptation.meta.network_functions` is of the networks."""
    depth_weight = config.adapt.depth_weight if meta.rehearse_depth else 0.0

    def refiner_loss(variables, after, inputs, complete):
        points = toy_refine(variables, after)
        return jax.vmap(toy_depth)(points, complete, inputs.view).mean()

    return Functions(
        toy_encode,
        toy_decode,
        lambda variables, inputs: toy_objective(variables, inputs, depth_weight),
        lambda stages, complete: toy_loss(stages, complete, meta.norm),
        refiner_loss,
    )


def gradients_of_toys(variables, inputs, complete, config, meta):
    """Gradients and terms of Eq. 12, of toy functions."""
    functions = toy_functions(config, meta)
    learned = learned_part(variables, meta)
    batch = (variables, inputs, complete)
    gradient = jax.grad(meta_loss, has_aux=True)
    return gradient(learned, *batch, functions, config.adapt, meta)


def toy_inputs():
    """Variables, inputs and complete clouds of the toy."""
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
    variables = {"params": params, "batch_stats": {}, "weighting": weighting}
    inputs = ToyInput(numbers(CLOUDS, POINTS, 3), numbers(CLOUDS))
    complete = numbers(CLOUDS, 9, 3)
    return variables, inputs, complete


def of_the_weighted_sum(logits, losses, scales):
    """d/d eta of sum softmax(eta) l / s = w (l / s - sum w l / s)."""
    weights = np.exp(logits) / np.exp(logits).sum()
    terms = np.asarray(losses.auxiliary) / scales
    return weights * (terms - weights @ terms)


def inner_loss(encoders, variables, inputs, config, meta):
    depth_weight = config.adapt.depth_weight if meta.rehearse_depth else 0.0
    _, rest = pop_encoders(variables)
    losses, _ = toy_objective(put_encoders(encoders, rest), inputs, depth_weight)
    return losses.objective


def toy_primary(variables, inputs, complete, meta):
    return toy_loss(toy_predict(variables, inputs).stages, complete, meta.norm)


def toy_adapted(variables, inputs, config, meta):
    encoders, rest = pop_encoders(variables)
    learned = variables["weighting"]["log_steps"]
    for _ in range(meta.num_steps):
        whole = put_encoders(encoders, rest)
        slope = jax.grad(inner_loss)(encoders, whole, inputs, config, meta)
        if meta.first_order:
            slope = jax.lax.stop_gradient(slope)
        norm = sum((leaf**2).sum() for leaf in jax.tree.leaves(slope)) ** 0.5
        bound, size = config.adapt.clip_norm, config.adapt.step_size
        size = size * jnp.minimum(1.0, bound / norm) if bound else size
        encoders = jax.tree.map(
            lambda p, g, s, size=size: p - size * jnp.exp(s) * g,
            encoders,
            slope,
            learned,
        )
    return put_encoders(encoders, rest)


def eq_12(variables, inputs, complete, config, meta):
    """Eq. 12 without its auxiliary term, as one function of all variables; the decoder
    has no part in the inner loop's derivative, nor in the zero-step term's."""
    held = variables
    if meta.num_steps:
        decoder = jax.lax.stop_gradient(variables["params"]["decoder"])
        held = {**variables, "params": {**variables["params"], "decoder": decoder}}
    adapted = toy_adapted(held, inputs, config, meta)
    params = {**adapted["params"], "decoder": variables["params"]["decoder"]}
    end = toy_primary({**adapted, "params": params}, inputs, complete, meta)
    start = toy_primary(held, inputs, complete, meta)
    return (1 - meta.beta_0) * end + meta.beta_0 * start


def eq_3(refiner, variables, inputs, complete, config, meta):
    adapted = toy_adapted(variables, inputs, config, meta)
    params = {**adapted["params"], "refiner": refiner}
    adapted = {**adapted, "params": params}
    points = toy_refine(adapted, toy_predict(adapted, inputs))
    return toy_depth(points, complete, inputs.view)


def expected_gradients(toy, config, meta):
    variables, inputs, complete = toy

    def of_cloud(one, complete):
        encoders, _ = pop_encoders(variables)
        refiner, settings = variables["params"]["refiner"], (config, meta)
        return (
            jax.grad(eq_12)(variables, one, complete, *settings),
            jax.grad(eq_3)(refiner, variables, one, complete, *settings),
            jax.grad(inner_loss)(encoders, variables, one, *settings),
            toy_objective(variables, one, 0.0)[0],
        )

    # One compilation, where every operation of its own has one else.
    of_cloud = jax.jit(of_cloud)
    parts = [of_cloud(row(inputs, i), complete[i]) for i in range(CLOUDS)]
    whole, refiner, auxiliary, losses = jax.device_get(mean(parts))
    factor = (1 - meta.beta_0) * meta.lambda_aux
    params = {
        name: jax.tree.map(
            lambda g, a: g + factor * a, whole["params"][name], auxiliary[name]
        )
        for name in ENCODERS
    }
    params["decoder"] = whole["params"]["decoder"]
    if meta.learn_auxiliary:
        params["auxiliary"] = whole["params"]["auxiliary"]
    if meta.learn_refiner:
        params["refiner"] = refiner
    own = jax.device_get(variables["weighting"])
    weighting = {"logits": whole["weighting"]["logits"]}
    if meta.weight_rule == "auxiliary":
        weighting["logits"] = of_the_weighted_sum(own["logits"], losses, own["scales"])
    if meta.learn_steps:
        weighting["log_steps"] = whole["weighting"]["log_steps"]
    return {"params": params, "weighting": weighting}
