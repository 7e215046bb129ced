"""Training on Eq. 10 alone: the backbone's phases, and any network to compare with."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from prism_jax.data.pipeline import Batch
from prism_jax.geometry.neighbors import nearest
from prism_jax.losses.chamfer import chamfer, stage_chamfers
from prism_jax.models import backbone
from prism_jax.models.config import BackboneConfig
from prism_jax.models.variables import Variables
from prism_jax.training.config import PhaseConfig, PretrainConfig
from prism_jax.training.inputs import visibility_of
from prism_jax.training.optimisers import optimiser
from prism_jax.training.phase import Phase, TrainState, averaged, steps_of

Stages = tuple[Float[Array, "B _ 3"], ...]


def backbone_phase(
    variables: Variables,
    config: BackboneConfig,
    phase: PhaseConfig,
    training: PretrainConfig,
) -> Phase:
    """Encoder and decoder on the stages that the phase trains."""
    blocks = len(config.up_factors) if phase.num_blocks is None else phase.num_blocks
    names = ("seeds", *(f"stage_{i + 1}" for i in range(blocks)))

    def train(variables: Variables, batch: Batch) -> tuple[Stages, Variables]:
        partial, visibility = jnp.asarray(batch.partial), visibility_of(batch, config)
        decoded, statistics = backbone.train_backbone(
            variables, config, partial, phase.num_blocks, visibility
        )
        return decoded.stages, statistics

    def stages(variables: Variables, batch: Batch) -> Stages:
        partial, visibility = jnp.asarray(batch.partial), visibility_of(batch, config)
        encoded = backbone.encode_points(variables, config, partial)
        decoded = backbone.decode(variables, config, partial, encoded, None, visibility)
        return decoded.stages[: blocks + 1]

    return supervised_phase(variables, train, stages, names, phase, training)


def supervised_phase(
    variables: Variables,
    train_fn: Callable[[Variables, Batch], tuple[Stages, Variables]],
    stages_fn: Callable[[Variables, Batch], Stages],
    names: tuple[str, ...],
    phase: PhaseConfig,
    training: PretrainConfig,
) -> Phase:
    """The terms of Eq. 10, of the stages that ``train_fn`` returns with BatchNorm's
    updated statistics; validated on those of ``stages_fn``, by CD-L2 in the unit of the
    scores, and the last stage by F at 2 % of the unseen part too. What decides is the
    mean logarithm of its CD-L1."""
    num_steps = steps_of(phase.name, phase.num_samples, training.batch_size)
    limits = training.warmup_steps, training.clip_norm
    kind = training.optimiser
    descent = optimiser(kind, phase.learning_rate, num_steps, phase.final_rate, *limits)

    def loss_fn(params: Variables, batch_stats: Variables, batch: Batch):
        variables = {"params": params, "batch_stats": batch_stats}
        stages, statistics = train_fn(variables, batch)
        terms = jax.vmap(functools.partial(stage_chamfers, norm=training.norm))
        losses = terms(stages, jnp.asarray(batch.complete)).mean(0)
        return losses.sum(), (losses, statistics)

    @jax.jit
    def step(state: TrainState, batch: Batch):
        variables = state.variables
        grads, (losses, statistics) = jax.grad(loss_fn, has_aux=True)(
            variables["params"], variables["batch_stats"], batch
        )
        params = variables["params"]
        updates, opt_state = descent.update(grads, state.opt_state, params)
        params = optax.apply_updates(params, updates)
        variables = {"params": params, "batch_stats": statistics}
        # It forgets sooner at first, so that it soon is one of trained variables.
        kept = (1.0 + state.step) / (10.0 + state.step)
        kept = jnp.minimum(training.average_decay, kept)
        average = averaged(state.average, variables, kept)
        return TrainState(state.step + 1, variables, opt_state, average), losses

    @jax.jit
    def validate(variables: Variables, batch: Batch):
        complete = jnp.asarray(batch.complete)
        stages, scale = stages_fn(variables, batch), jnp.asarray(batch.scale)
        scores = [jax.vmap(chamfer)(stage, complete) * scale**2 for stage in stages]
        plain = jax.vmap(lambda s, c: chamfer(s, c, "l1"))(stages[-1], complete)
        unseen = jax.vmap(_unseen_f)(stages[-1], jnp.asarray(batch.partial), complete)
        return jnp.stack([*scores, unseen, jnp.log(plain * scale)], -1)

    average = variables if training.average_decay else None
    opt_state = descent.init(variables["params"])
    start = TrainState(jnp.int32(0), variables, opt_state, average)
    sizes = phase.num_samples, training.batch_size, training.num_complete
    told = names, (*names, "f_2", "log_cd_l1")
    return Phase(phase.name, *sizes, start, step, validate, *told, phase.patience)


def _unseen_f(
    points: Float[Array, "N 3"],
    partial: Float[Array, "P 3"],
    complete: Float[Array, "M 3"],
) -> Float[Array, ""]:
    """F at 2 % of the longest side of what lies farther than that from all points that
    the network reads: of the truth, and of its own points (`unseen_scores` of the
    metrics has all measured ones). Nothing added has a precision of 0, nothing unseen
    a recall of 1."""
    reach = 0.02 * (complete.max(0) - complete.min(0)).max()

    def share(cloud: Array, other: Array, of_none: float) -> Array:
        added = nearest(cloud, partial)[0] > reach**2
        right = added & (nearest(cloud, other)[0] <= reach**2)
        return jnp.where(
            added.any(), right.sum() / jnp.maximum(added.sum(), 1), of_none
        )

    precision, recall = share(points, complete, 0.0), share(complete, points, 1.0)
    return 2 * precision * recall / jnp.maximum(precision + recall, 1e-12)
