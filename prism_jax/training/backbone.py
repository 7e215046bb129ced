"""Pretraining, stage A: the backbone on Eq. 10, coarse stages first."""

import jax.numpy as jnp

from prism_jax.data.pipeline import Batch
from prism_jax.models.backbone import (
    decode,
    encode_points,
    partial_indices,
    train_backbone,
)
from prism_jax.models.config import BackboneConfig
from prism_jax.models.variables import Variables
from prism_jax.training.config import PhaseConfig, PretrainConfig
from prism_jax.training.inputs import indices_of, visibility_of
from prism_jax.training.phase import Phase
from prism_jax.training.supervised import Stages, supervised_phase


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
        partial = jnp.asarray(batch.partial)
        indices = indices_of(batch)
        if indices is None:
            indices = partial_indices(partial, config)
        decoded, statistics = train_backbone(
            variables,
            config,
            partial,
            indices,
            phase.num_blocks,
            visibility_of(batch, config),
        )
        return decoded.stages, statistics

    def stages(variables: Variables, batch: Batch) -> Stages:
        partial, visibility = jnp.asarray(batch.partial), visibility_of(batch, config)
        indices = partial_indices(partial, config)
        encoded = encode_points(variables, config, partial, indices)
        decoded = decode(variables, config, partial, encoded, None, visibility)
        return decoded.stages[: blocks + 1]

    return supervised_phase(variables, train, stages, names, phase, training)
