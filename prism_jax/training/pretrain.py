"""Jitted steps of the backbone's pretraining on Eq. 10."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from prism_jax.losses.chamfer import chamfer
from prism_jax.losses.primary import stage_chamfers
from prism_jax.models.backbone import (
    Variables,
    decode,
    encode_points,
    partial_indices,
    train_backbone,
)
from prism_jax.models.config import BackboneConfig
from prism_jax.training.batches import Batch
from prism_jax.training.config import PhaseConfig, PretrainConfig


class TrainState(NamedTuple):
    """What a step changes and a checkpoint holds."""

    step: Int[Array, ""]
    variables: Variables
    opt_state: Any


StepFn = Callable[[TrainState, Batch], tuple[TrainState, Float[Array, " S"]]]


def backbone_optimiser(
    phase: PhaseConfig, config: PretrainConfig
) -> optax.GradientTransformation:
    """Adam under a clipped gradient: linear warm-up, then a cosine."""
    num_steps = phase.num_samples // config.batch_size
    schedule = optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=phase.learning_rate,
        warmup_steps=min(config.warmup_steps, num_steps // 2),
        decay_steps=num_steps,
        end_value=phase.final_rate * phase.learning_rate,
    )
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm), optax.adam(schedule)
    )


def start_phase(variables: Variables, optimiser: optax.GradientTransformation):
    """A state at step 0 with these variables."""
    return TrainState(jnp.int32(0), variables, optimiser.init(variables["params"]))


def make_backbone_step(
    model: BackboneConfig,
    phase: PhaseConfig,
    config: PretrainConfig,
    optimiser: optax.GradientTransformation,
) -> StepFn:
    """One jitted update on the stages that the phase trains; returns their losses."""

    def loss_fn(params, batch_stats, batch: Batch):
        variables = {"params": params, "batch_stats": batch_stats}
        partial = jnp.asarray(batch.partial)
        decoded, statistics = train_backbone(
            variables, model, partial, phase.num_blocks
        )
        losses = jax.vmap(lambda s, c: stage_chamfers(s, c, config.norm))(
            decoded.stages, jnp.asarray(batch.complete)
        ).mean(0)
        return losses.sum(), (losses, statistics)

    @jax.jit
    def step(state: TrainState, batch: Batch):
        variables = state.variables
        grads, (losses, statistics) = jax.grad(loss_fn, has_aux=True)(
            variables["params"], variables["batch_stats"], batch
        )
        updates, opt_state = optimiser.update(grads, state.opt_state)
        params = optax.apply_updates(variables["params"], updates)
        variables = {"params": params, "batch_stats": statistics}
        return TrainState(state.step + 1, variables, opt_state), losses

    return step


def make_validation(
    model: BackboneConfig,
) -> Callable[[Variables, Batch], Float[Array, "B S"]]:
    """CD-L2 of every stage of every example, in the units of the stored examples."""

    @jax.jit
    def validate(variables: Variables, batch: Batch):
        partial, complete = jnp.asarray(batch.partial), jnp.asarray(batch.complete)
        encoded = encode_points(
            variables, model, partial, partial_indices(partial, model)
        )
        stages = decode(variables, model, partial, encoded).stages
        distances = [jax.vmap(chamfer)(stage, complete) for stage in stages]
        return jnp.stack(distances, -1) * jnp.asarray(batch.half_extent)[:, None] ** 2

    return validate
