"""A toy that stands in for the networks and losses of the meta-objective.

A few numbers a module, and smooth losses in the place of Eq. 3 to 10; Eq. 11 is the
real one. What Eq. 12 asks of it is written out here as functions of all variables.
"""

import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.objective import Losses
from prism_jax.losses.weighting import weighted_auxiliary
from prism_jax.models.encoder import PointFeatures
from prism_jax.models.prism import NetworkInput, Prediction
from prism_jax.models.variables import ENCODERS, pop_encoders, put_encoders
from tests.trees import mean, row

TOY = PrismConfig().with_adapt(step_size=0.2, depth_weight=0.7)
FRAMES, POINTS = 2, 6


def toy_encode(variables, frame, model):
    point = variables["params"]["point_encoder"]
    code = jnp.tanh(frame.partial.mean(0) * point["first"] + point["second"] ** 2)
    return PointFeatures(*[code] * len(PointFeatures._fields))


def toy_completed(variables, frame, encoded, model):
    """Of one frame or several, as the network's."""
    code = encoded.global_feature
    decoder, spread = variables["params"]["decoder"]["only"], code[..., None, :]
    seeds = frame.partial[..., :3, :] * decoder + spread
    last = (frame.partial + spread) * jnp.cos(decoder)
    made = Prediction(last, (seeds, last), jnp.sin(frame.partial + spread), encoded)
    return made._replace(points=toy_refine(variables, made, model))


def toy_predict(variables, frame, model):
    return toy_completed(variables, frame, toy_encode(variables, frame, model), model)


def toy_refine(variables, decoded, model):
    own = variables["params"]["refiner"]["only"]
    return decoded.stages[-1] + 0.1 * jnp.tanh(own * decoded.features)


def toy_objective(variables, frame, config):
    made = toy_predict(variables, frame, config.model)
    code, weighting = made.encoded.global_feature, variables["weighting"]
    depth = jnp.sin(variables["params"]["depth_encoder"]["only"])
    branch = variables["params"]["auxiliary"]["only"]
    consistency = ((made.points - frame.partial) ** 2).mean()
    terms = jnp.stack(
        [
            (jnp.sin(code * branch) ** 2).sum() + (made.points**2).mean(),
            ((code - depth) ** 2).sum(),
            ((branch * code * depth) ** 2).sum(),
        ]
    )
    weighted = weighted_auxiliary(weighting["logits"], terms, weighting["scales"])
    objective = config.adapt.depth_weight * consistency + weighted
    return Losses(objective, consistency, *terms), made


def toy_loss(stages, complete, norm):
    """Point by point, unsquared or squared."""
    squares = [((s - complete[: len(s)]) ** 2).sum(-1) for s in stages]
    return sum(jnp.mean(s if norm == "l2" else jnp.sqrt(s)) for s in squares)


def toy_depth(predicted, complete, view):
    return ((predicted - view * complete[: len(predicted)]) ** 2).mean()


def toy_inputs():
    """Variables, frames and complete clouds of the toy."""
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
    unused = numbers(FRAMES)
    frames = NetworkInput(*[unused] * len(NetworkInput._fields))
    frames = frames._replace(partial=numbers(FRAMES, POINTS, 3), view=numbers(FRAMES))
    return variables, frames, numbers(FRAMES, 9, 3)


def toy_hold(variables, frame, model):
    return frame


STAND_INS = {
    "hold_decoding": toy_hold,
    "encode": toy_encode,
    "decode_and_refine": toy_completed,
    "refine": toy_refine,
    "test_time_objective": toy_objective,
    "depth_supervised": toy_depth,
    "primary_loss": toy_loss,
}
"""What `prism_jax.adaptation.meta` knows of the networks."""


def of_the_weighted_sum(logits, losses, scales):
    """d/d eta of sum softmax(eta) l / s = w (l / s - sum w l / s)."""
    weights = np.exp(logits) / np.exp(logits).sum()
    terms = np.array([losses.normal, losses.denoise, losses.align]) / scales
    return weights * (terms - weights @ terms)


def inner_loss(encoders, variables, frame, config, meta):
    depth_weight = config.adapt.depth_weight if meta.rehearse_depth else 0.0
    inner = config.with_adapt(depth_weight=depth_weight)
    _, rest = pop_encoders(variables)
    losses, _ = toy_objective(put_encoders(encoders, rest), frame, inner)
    return losses.objective


def toy_primary(variables, frame, complete, meta):
    made = toy_predict(variables, frame, None)
    return toy_loss(made.stages, complete, meta.norm)


def toy_adapted(variables, frame, config, meta):
    encoders, rest = pop_encoders(variables)
    learned = variables["weighting"]["log_steps"]
    for _ in range(meta.num_steps):
        whole = put_encoders(encoders, rest)
        slope = jax.grad(inner_loss)(encoders, whole, frame, config, meta)
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


def eq_12(variables, frame, complete, config, meta):
    """Eq. 12 without its auxiliary term, as one function of all variables; the decoder
    has no part in the inner loop's derivative, nor in the zero-step term's."""
    held = variables
    if meta.num_steps:
        decoder = jax.lax.stop_gradient(variables["params"]["decoder"])
        held = {**variables, "params": {**variables["params"], "decoder": decoder}}
    adapted = toy_adapted(held, frame, config, meta)
    params = {**adapted["params"], "decoder": variables["params"]["decoder"]}
    end = toy_primary({**adapted, "params": params}, frame, complete, meta)
    start = toy_primary(held, frame, complete, meta)
    return (1 - meta.beta_0) * end + meta.beta_0 * start


def eq_3(refiner, variables, frame, complete, config, meta):
    adapted = toy_adapted(variables, frame, config, meta)
    params = {**adapted["params"], "refiner": refiner}
    made = toy_predict({**adapted, "params": params}, frame, None)
    return toy_depth(made.points, complete, frame.view)


def expected_gradients(toy, config, meta):
    variables, frames, complete = toy

    def of_frame(frame, complete):
        encoders, _ = pop_encoders(variables)
        refiner, settings = variables["params"]["refiner"], (config, meta)
        return (
            jax.grad(eq_12)(variables, frame, complete, *settings),
            jax.grad(eq_3)(refiner, variables, frame, complete, *settings),
            jax.grad(inner_loss)(encoders, variables, frame, *settings),
            toy_objective(variables, frame, config)[0],
        )

    parts = [of_frame(row(frames, i), complete[i]) for i in range(FRAMES)]
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
