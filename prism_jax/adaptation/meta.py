"""The meta-objective, Eq. 12: a completion is judged after its encoders have adapted.

An episode is one frame, as at test time: its own encoders take ``num_steps`` steps on
the weighted auxiliary losses (Eq. 11), and Eq. 10 of what they then encode, decoded by
the shared decoder, is differentiated through those steps.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.adaptation.config import MetaConfig, PrismConfig
from prism_jax.adaptation.inner_loop import descend, step_sizes, unroll
from prism_jax.adaptation.objective import Losses, test_time_objective
from prism_jax.losses.depth import depth_supervised
from prism_jax.losses.primary import primary_loss
from prism_jax.losses.weighting import update_scale, weighted_auxiliary
from prism_jax.models.encoder import PointFeatures
from prism_jax.models.prism import (
    NetworkInput,
    Prediction,
    decode_and_refine,
    encode,
    hold_decoding,
    refine,
)
from prism_jax.models.variables import (
    ENCODERS,
    Variables,
    pop_encoders,
    put_encoders,
)


class MetaTerms(NamedTuple):
    """What a meta-step measures, as means over its frames.

    Attributes:
      adapted: Eq. 10 with the adapted encoders.
      zero_step: Eq. 10 with the encoders as they are.
      losses: of Eq. 11 and 13 before adaptation; ``objective`` is what the inner loop
        descends.
      refined: Eq. 3 of the refined points.
    """

    adapted: Float[Array, ""]
    zero_step: Float[Array, ""]
    losses: Losses
    refined: Float[Array, ""]


def meta_gradients(
    variables: Variables,
    inputs: NetworkInput,
    complete: Float[Array, "B M 3"],
    config: PrismConfig,
    meta: MetaConfig,
) -> tuple[Variables, MetaTerms]:
    """Gradients of Eq. 12 over a batch of frames, each to the leaf that it is for.

    The tree is that of the variables, with what learns and nothing else:

    - encoders: from ``(1 - beta_0) (L_pri(enc', dec) + lambda_aux L_aux(enc)) + beta_0
      L_pri(enc)``, differentiated through the inner loop; with ``rehearse_depth`` L_aux
      is all that the inner loop descends, Eq. 13;
    - decoder: from ``(1 - beta_0) L_pri(enc', dec)`` with the adapted encoders as
      given: the zero-step term of Eq. 12 names no decoder, and the inner loop, as at
      test time, holds it fixed. Without inner steps both terms are one, and it has all;
    - auxiliary modules: from the adapted primary loss, if they learn;
    - refiner: from Eq. 3 of the adapted completion alone, if it learns;
    - logits: from L_aux of Eq. 11 (``weight_rule="auxiliary"``), or from the adapted
      primary loss (``"meta"``);
    - log_steps: from the adapted primary loss, if they are learned.

    `complete` is in farthest-point order. BatchNorm statistics are read as they are,
    as at test time.
    """
    by_primary = dataclasses.replace(meta, learn_refiner=False)
    moving = learned_part(variables, by_primary)

    def loss_fn(moving: Variables):
        return _primary_terms(moving, variables, inputs, complete, config, meta)

    grads, (terms, auxiliary, refiner) = jax.grad(loss_fn, has_aux=True)(moving)
    params, weighting = grads["params"], grads["weighting"]
    if meta.learn_refiner:
        params["refiner"] = refiner
    if meta.lambda_aux:
        factor = (1.0 - meta.beta_0) * meta.lambda_aux
        for name, tree in auxiliary.items():
            params[name] = jax.tree.map(lambda g, a: g + factor * a, params[name], tree)
    if meta.weight_rule == "auxiliary":
        own = variables["weighting"]
        weighting["logits"] = jax.grad(weighted_auxiliary)(
            own["logits"], _three(terms.losses), own["scales"]
        )
    return grads, terms


def _primary_terms(
    moving: Variables,
    variables: Variables,
    inputs: NetworkInput,
    complete: Float[Array, "B M 3"],
    config: PrismConfig,
    meta: MetaConfig,
) -> tuple[Float[Array, ""], tuple[MetaTerms, Variables, Variables]]:
    """The primary terms of Eq. 12, differentiable in ``moving``.

    Beside them all terms, and two gradients that no other derivative is to pass
    through: of L_aux in the encoders, and of Eq. 3 in the refiner.
    """
    variables = put_learned(moving, variables)

    def primary(stages: tuple[Array, ...], complete: Array) -> Array:
        return primary_loss(stages, complete, meta.norm)

    def one(inputs: NetworkInput, complete: Array):
        found = episode(variables, inputs, config, meta)
        return found, primary(found.before, complete)

    def decoded(encoded: PointFeatures) -> Prediction:
        return decode_and_refine(variables, inputs, encoded, config.model)

    if meta.remat:
        decoded = jax.checkpoint(decoded)
    if meta.num_steps:
        held = jax.lax.stop_gradient(variables)
        inputs = jax.vmap(lambda f: hold_decoding(held, f, config.model))(inputs)
    episodes, zero_step = jax.vmap(one)(inputs, complete)
    # All frames share the decoder: as one batch, its derivative is one product.
    after = decoded(episodes.encoded)
    adapted = jax.vmap(primary)(after.stages, complete).mean()
    zero_step = zero_step.mean() if meta.num_steps else adapted
    refined, refiner = jax.value_and_grad(_refined)(
        variables["params"]["refiner"], after, inputs, complete, config
    )
    loss = (1.0 - meta.beta_0) * adapted + meta.beta_0 * zero_step
    losses, auxiliary = _mean((episodes.losses, episodes.auxiliary))
    terms = MetaTerms(adapted, zero_step, losses, refined)
    return loss, jax.lax.stop_gradient((terms, auxiliary, refiner))


class Episode(NamedTuple):
    """What the inner loop makes of one frame.

    Attributes:
      encoded: by the adapted encoders.
      before: the decoder's stages before adaptation.
      losses: before adaptation.
      auxiliary: gradient, in the encoders, of what the inner loop descends.
    """

    encoded: PointFeatures
    before: tuple[Float[Array, "_ 3"], ...]
    losses: Losses
    auxiliary: Variables


def episode(
    variables: Variables, inputs: NetworkInput, config: PrismConfig, meta: MetaConfig
) -> Episode:
    """One frame's inner loop, which holds the decoder."""
    encoders, rest = pop_encoders(variables)
    held = _hold_decoder(rest)
    inner = config if meta.rehearse_depth else config.with_adapt(depth_weight=0.0)

    def objective(encoders: Variables):
        losses, prediction = test_time_objective(
            put_encoders(encoders, held), inputs, inner
        )
        return losses.objective, (losses, prediction.stages)

    def encoded(encoders: Variables) -> PointFeatures:
        return encode(put_encoders(encoders, rest), inputs, config.model)

    if meta.remat:
        objective, encoded = jax.checkpoint(objective), jax.checkpoint(encoded)
    sizes = step_sizes(variables, config.adapt)
    (_, (losses, before)), auxiliary = jax.value_and_grad(objective, has_aux=True)(
        encoders
    )
    if meta.num_steps:
        how = (meta.first_order, config.adapt.clip_norm)
        encoders = descend(encoders, auxiliary, sizes, *how)
        if meta.num_steps > 1:
            encoders, _ = unroll(objective, encoders, sizes, meta.num_steps - 1, *how)
    return Episode(encoded(encoders), before, losses, auxiliary)


def learned_part(variables: Variables, meta: MetaConfig) -> Variables:
    """What a meta-step learns: the part of the variables that has gradients."""
    modules, weights = [*ENCODERS, "decoder"], ["logits"]
    if meta.learn_auxiliary:
        modules.append("auxiliary")
    if meta.learn_refiner:
        modules.append("refiner")
    if meta.learn_steps:
        weights.append("log_steps")
    return {
        "params": {name: variables["params"][name] for name in modules},
        "weighting": {name: variables["weighting"][name] for name in weights},
    }


def put_learned(learned: Variables, variables: Variables) -> Variables:
    """The variables with these in the place of theirs."""
    return {
        **variables,
        "params": {**variables["params"], **learned["params"]},
        "weighting": {**variables["weighting"], **learned["weighting"]},
    }


def _hold_decoder(rest: Variables) -> Variables:
    decoder = jax.lax.stop_gradient(rest["params"]["decoder"])
    return {**rest, "params": {**rest["params"], "decoder": decoder}}


def measured_scales(variables: Variables, terms: MetaTerms) -> Float[Array, "3"]:
    """The scales of Eq. 11, moved towards what this step measured."""
    return update_scale(variables["weighting"]["scales"], _three(terms.losses))


def _refined(
    refiner: Variables,
    after: Prediction,
    inputs: NetworkInput,
    complete: Float[Array, "B M 3"],
    config: PrismConfig,
) -> Float[Array, ""]:
    after = jax.lax.stop_gradient(after)
    own = {"params": {"refiner": refiner}, "batch_stats": {}}
    points = refine(own, after, config.model)
    return jax.vmap(depth_supervised)(points, complete, inputs.view).mean()


def _three(losses: Losses) -> Float[Array, "3"]:
    return jnp.stack([losses.normal, losses.denoise, losses.align])


def _mean(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf.mean(0), tree)
