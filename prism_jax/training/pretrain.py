"""Pretraining, stage A: the backbone on Eq. 10, then all that reads it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from prism_jax.data.pipeline import Batch
from prism_jax.losses.chamfer import chamfer
from prism_jax.losses.primary import stage_chamfers
from prism_jax.models.backbone import (
    decode,
    encode_points,
    partial_indices,
    train_backbone,
)
from prism_jax.models.config import BackboneConfig
from prism_jax.models.encoder import EncoderIndices
from prism_jax.models.variables import Variables
from prism_jax.training.config import PhaseConfig, PretrainConfig
from prism_jax.training.leg import Leg, TrainState


def adam(
    learning_rate: float, num_steps: int, final_rate: float, config: PretrainConfig
) -> optax.GradientTransformation:
    """Adam under a clipped gradient: linear warm-up, then a cosine."""
    schedule = optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=learning_rate,
        warmup_steps=min(config.warmup_steps, num_steps // 2),
        decay_steps=num_steps,
        end_value=final_rate * learning_rate,
    )
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm), optax.adam(schedule)
    )


def backbone_leg(
    variables: Variables,
    model: BackboneConfig,
    phase: PhaseConfig,
    config: PretrainConfig,
) -> Leg:
    """Encoder and decoder on the stages that the phase trains (Eq. 10)."""
    blocks = len(model.up_factors) if phase.num_blocks is None else phase.num_blocks
    stages = ("seeds", *(f"stage_{i + 1}" for i in range(blocks)))
    optimiser = adam(
        phase.learning_rate,
        phase.num_samples // config.batch_size,
        phase.final_rate,
        config,
    )
    return Leg(
        phase.name,
        phase.num_samples,
        config.batch_size,
        config.num_complete,
        TrainState(jnp.int32(0), variables, optimiser.init(variables["params"])),
        _backbone_step(model, phase, config, optimiser),
        _backbone_validation(model, phase.num_blocks),
        stages,
        stages,
    )


def _backbone_step(model, phase, config, optimiser):
    def loss_fn(params, batch_stats, batch: Batch):
        variables = {"params": params, "batch_stats": batch_stats}
        partial = jnp.asarray(batch.partial)
        indices = _indices(batch, partial, model)
        decoded, statistics = train_backbone(
            variables, model, partial, indices, phase.num_blocks
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


def _indices(batch: Batch, partial: Array, model: BackboneConfig) -> EncoderIndices:
    """Those that come with the batch, or else computed here."""
    if batch.indices is None:
        return partial_indices(partial, model)
    return jax.tree.map(lambda rows: jnp.asarray(rows, jnp.int32), batch.indices)


def _backbone_validation(
    model: BackboneConfig, num_blocks: int | None
) -> Callable[[Variables, Batch], Float[Array, "B S"]]:
    """CD-L2 of every trained stage, in the units of the stored examples."""

    @jax.jit
    def validate(variables: Variables, batch: Batch):
        partial, complete = jnp.asarray(batch.partial), jnp.asarray(batch.complete)
        encoded = encode_points(
            variables, model, partial, partial_indices(partial, model)
        )
        stages = decode(variables, model, partial, encoded).stages
        trained = stages if num_blocks is None else stages[: num_blocks + 1]
        distances = [jax.vmap(chamfer)(stage, complete) for stage in trained]
        return jnp.stack(distances, -1) * jnp.asarray(batch.half_extent)[:, None] ** 2

    return validate
