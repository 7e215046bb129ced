"""Pretraining, stage A: the backbone on Eq. 10, coarse stages first."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from prism_jax.data.pipeline import Batch
from prism_jax.geometry.visibility import Visibility
from prism_jax.models.backbone import (
    decode,
    encode_points,
    partial_indices,
    train_backbone,
)
from prism_jax.models.config import BackboneConfig, ModelConfig
from prism_jax.models.encoder import EncoderIndices
from prism_jax.models.variables import Variables
from prism_jax.training.config import PhaseConfig, PretrainConfig
from prism_jax.training.inputs import visibility_of
from prism_jax.training.phase import Phase
from prism_jax.training.supervised import (
    Losses,
    Stages,
    stage_losses,
    supervised_phase,
)


def backbone_phase(
    variables: Variables,
    model: ModelConfig,
    phase: PhaseConfig,
    training: PretrainConfig,
) -> Phase:
    """Encoder and decoder on the stages that the phase trains."""
    backbone = model.backbone
    blocks = len(backbone.up_factors) if phase.num_blocks is None else phase.num_blocks
    names = ("seeds", *(f"stage_{i + 1}" for i in range(blocks)))

    def known(batch: Batch) -> Visibility | None:
        return visibility_of(batch) if backbone.reads_visibility else None

    def train(variables: Variables, batch: Batch, _: Array) -> tuple[Losses, Variables]:
        partial = jnp.asarray(batch.partial)
        indices = _indices(batch, partial, backbone)
        decoded, statistics = train_backbone(
            variables, model, partial, indices, phase.num_blocks, known(batch)
        )
        return stage_losses(decoded.stages, batch, training.norm), statistics

    def stages(variables: Variables, batch: Batch) -> Stages:
        partial = jnp.asarray(batch.partial)
        indices = partial_indices(partial, backbone)
        encoded = encode_points(variables, backbone, partial, indices)
        decoded = decode(variables, backbone, partial, encoded, None, known(batch))
        return decoded.stages[: blocks + 1]

    return supervised_phase(variables, train, stages, names, phase, training)


def _indices(batch: Batch, partial: Array, model: BackboneConfig) -> EncoderIndices:
    """Those that come with the batch, or else computed here."""
    if batch.indices is None:
        return partial_indices(partial, model)
    return jax.tree.map(lambda rows: jnp.asarray(rows, jnp.int32), batch.indices)
