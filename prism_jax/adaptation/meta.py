"""The meta-objective, Eq. 12: a completion is judged after its encoders have adapted.

An episode is one cloud, as at test time: its own encoders take ``num_steps`` steps on
the weighted auxiliary losses (Eq. 11), and Eq. 10 of what they then encode, decoded by
the shared decoder, is differentiated through those steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float

from prism_jax.adaptation.config import AdaptConfig, MetaConfig, PrismConfig
from prism_jax.adaptation.inner_loop import descend, step_sizes, unroll
from prism_jax.adaptation.objective import Losses, test_time_objective
from prism_jax.losses.chamfer import primary_loss
from prism_jax.losses.depth import depth_supervised
from prism_jax.losses.weighting import weighted_auxiliary
from prism_jax.models.prism import decode_and_refine, encode, hold_decoding, refine
from prism_jax.models.variables import ENCODERS, Variables, pop_encoders, put_encoders


class Functions(NamedTuple):
    """What Eq. 12 is composed of, as functions of all variables."""

    encode: Callable[[Variables, Any], Any]  # of one cloud's inputs
    # Of inputs and what was encoded of them, for a batch; what it returns has the
    # ``stages``.
    decode: Callable[[Variables, Any, Any], Any]
    # Eq. 11 of one cloud's inputs, or Eq. 13 where it is rehearsed: `Losses`, whose
    # ``objective`` the inner loop descends, and the prediction.
    auxiliary_loss: Callable[[Variables, Any], tuple[Losses, Any]]
    # Eq. 10 of one cloud's stages and the complete cloud.
    primary_loss: Callable[[Any, Array], Float[Array, ""]]
    # Eq. 3 of a batch: what was decoded, inputs, complete clouds.
    refiner_loss: Callable[[Variables, Any, Any, Array], Float[Array, ""]]


class MetaTerms(NamedTuple):
    """What a meta-step measures, as means over its clouds."""

    adapted: Float[Array, ""]  # eq. 10 with the adapted encoders
    zero_step: Float[Array, ""]  # eq. 10 with the encoders as they are
    # Of Eq. 11 and 13 before adaptation; ``objective`` is what the inner loop descends.
    losses: Losses
    refined: Float[Array, ""]  # eq. 3 of the refined points


def meta_loss(
    learned: Variables,
    variables: Variables,
    inputs: Any,
    complete: Float[Array, "B M 3"],
    functions: Functions,
    adapt: AdaptConfig,
    meta: MetaConfig,
) -> tuple[Float[Array, ""], MetaTerms]:
    """Eq. 12 over a batch, as a function of what learns (`learned_part`).

    Its gradient takes each term to the leaves that the term is for:

    - encoders: from ``(1 - beta_0) (L_pri(enc', dec) + lambda_aux L_aux(enc)) + beta_0
      L_pri(enc)``, differentiated through the inner loop;
    - decoder: from ``(1 - beta_0) L_pri(enc', dec)`` with the adapted encoders as
      given: the zero-step term of Eq. 12 names no decoder, and the inner loop, as at
      test time, holds it fixed. Without inner steps both terms are one, and it has all;
    - auxiliary modules and log_steps: from L_pri(enc', dec), if they learn;
    - logits: from L_aux (``weight_rule="auxiliary"``) or L_pri(enc', dec) (``"meta"``);
    - refiner: from Eq. 3 of the adapted completion alone, if it learns.
    """
    if meta.remat:
        names = ("encode", "decode", "auxiliary_loss")
        anew = {name: jax.checkpoint(getattr(functions, name)) for name in names}
        functions = functions._replace(**anew)
    variables = put_learned(learned, variables)
    outer = _stopped(variables, "refiner")
    own_rule = meta.weight_rule == "auxiliary"
    inner = _stopped(outer, "decoder", *(["logits"] if own_rule else []))
    encoders, held = pop_encoders(inner)

    def episode(inputs: Any):
        def loss_fn(encoders: Variables):
            whole = put_encoders(encoders, held)
            losses, prediction = functions.auxiliary_loss(whole, inputs)
            return losses.objective, (losses, prediction.stages)

        (_, seen), slope = jax.value_and_grad(loss_fn, has_aux=True)(encoders)
        adapted = encoders
        if meta.num_steps:
            sizes, how = step_sizes(outer, adapt), (meta.first_order, adapt.clip_norm)
            adapted = descend(encoders, slope, sizes, *how)
            # A loop of no steps would still be compiled.
            if meta.num_steps > 1:
                adapted, _ = unroll(loss_fn, adapted, sizes, meta.num_steps - 1, *how)
        return functions.encode(put_encoders(adapted, held), inputs), *seen, slope

    encoded, losses, before, slope = jax.vmap(episode)(inputs)
    losses, slope = jax.tree.map(lambda leaf: leaf.mean(0), (losses, slope))
    # All clouds share the decoder: as one batch, its derivative is one product.
    after = functions.decode(outer, inputs, encoded)
    primary = jax.vmap(functions.primary_loss)
    adapted = zero_step = primary(after.stages, complete).mean()
    if meta.num_steps:
        zero_step = primary(before, complete).mean()
    loss = (1.0 - meta.beta_0) * adapted + meta.beta_0 * zero_step

    fixed = jax.lax.stop_gradient(after)
    refined = functions.refiner_loss(variables, fixed, inputs, complete)
    loss += refined
    if own_rule:
        weighting = variables["weighting"]
        fixed = jax.lax.stop_gradient(losses.auxiliary)
        loss += weighted_auxiliary(weighting["logits"], fixed, weighting["scales"])
    if meta.lambda_aux:
        # L_aux in the encoders alone. Its slope there is what the first inner step
        # descended, so it is not computed again: this has the same.
        fixed = jax.lax.stop_gradient(slope)
        along = jax.tree.map(lambda s, e: (s * e).sum(), fixed, encoders)
        factor = (1.0 - meta.beta_0) * meta.lambda_aux
        loss += factor * sum(jax.tree.leaves(along))
    return loss, MetaTerms(adapted, zero_step, losses, refined)


def meta_gradients(
    variables: Variables,
    inputs: Any,
    complete: Float[Array, "B M 3"],
    config: PrismConfig,
    meta: MetaConfig,
) -> tuple[Variables, MetaTerms]:
    """Gradients of `meta_loss` of the network, in the tree of `learned_part`.

    `complete` is in farthest-point order. Each cloud's decoding is held through its
    episode, as at test time.
    """
    if meta.num_steps:
        model = config.model
        inputs = jax.vmap(lambda one: hold_decoding(variables, one, model))(inputs)
    learned = learned_part(variables, meta)
    functions = network_functions(config, meta)
    gradient = jax.grad(meta_loss, has_aux=True)
    return gradient(learned, variables, inputs, complete, functions, config.adapt, meta)


def network_functions(config: PrismConfig, meta: MetaConfig) -> Functions:
    """The functions that Eq. 12 is composed of, of PRISM's network."""
    model = config.model
    # What the inner loop descends: Eq. 13 or Eq. 11.
    inner = config
    if not meta.rehearse_depth:
        inner = config.with_adapt(depth_weight=0.0, auxiliary_weight=1.0)

    def refiner_loss(variables: Variables, after: Any, inputs: Any, complete: Array):
        points = refine(variables, after, model)
        return jax.vmap(depth_supervised)(points, complete, inputs.view).mean()

    return Functions(
        lambda variables, inputs: encode(variables, inputs, model),
        lambda variables, inputs, encoded: decode_and_refine(
            variables, inputs, encoded, model
        ),
        lambda variables, inputs: test_time_objective(variables, inputs, inner),
        lambda stages, complete: primary_loss(stages, complete, meta.norm),
        refiner_loss,
    )


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
    changed = {kind: {**variables[kind], **tree} for kind, tree in learned.items()}
    return {**variables, **changed}


def _stopped(variables: Variables, *names: str) -> Variables:
    """The variables, those of some names without a gradient."""

    def stop(path: tuple, leaf: Array) -> Array:
        return jax.lax.stop_gradient(leaf) if path[1].key in names else leaf

    return jax.tree_util.tree_map_with_path(stop, variables)
