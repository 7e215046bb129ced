"""Pretraining, stage A: the backbone on Eq. 10, coarse stages first."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from prism_jax.data.pipeline import Batch
from prism_jax.geometry.visibility import Visibility
from prism_jax.io.errors import InputError
from prism_jax.models.backbone import (
    RenderedView,
    decode,
    encode_points,
    partial_indices,
    train_backbone,
    with_depth,
)
from prism_jax.models.config import BackboneConfig, ModelConfig
from prism_jax.models.encoder import EncoderIndices
from prism_jax.models.variables import Variables
from prism_jax.training.config import PhaseConfig, PretrainConfig
from prism_jax.training.inputs import view_of, visibility_of
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
    """Encoder and decoder on the stages that the phase trains, and the depth stream if
    the decoder reads it."""
    backbone = model.backbone
    blocks = len(backbone.up_factors) if phase.num_blocks is None else phase.num_blocks
    trained = slice(phase.first_block + 1 if phase.first_block else 0, blocks + 1)
    names = ("seeds", *(f"stage_{i + 1}" for i in range(blocks)))[trained]
    if not names:
        fault = f"trains no block: {phase.first_block} of {blocks} stay as they are"
        raise InputError(phase.name, fault, "add a block, or lower its first_block")

    def known(batch: Batch) -> Visibility | None:
        return visibility_of(batch) if backbone.reads_visibility else None

    def view(batch: Batch) -> RenderedView | None:
        return view_of(batch, model) if backbone.reads_depth else None

    def train(variables: Variables, batch: Batch, _: Array) -> tuple[Losses, Variables]:
        partial = jnp.asarray(batch.partial)
        indices = _indices(batch, partial, backbone)
        frozen = jax.lax.stop_gradient(variables["params"])
        params = _from_block(phase.first_block, variables["params"], frozen)
        decoded, statistics = train_backbone(
            {**variables, "params": params},
            model,
            partial,
            indices,
            phase.num_blocks,
            known(batch),
            view(batch),
        )
        before = variables["batch_stats"]
        statistics = _from_block(phase.first_block, statistics, before)
        losses = stage_losses(decoded.stages[trained], batch, training.norm)
        return losses, statistics

    def stages(variables: Variables, batch: Batch) -> Stages:
        partial = jnp.asarray(batch.partial)
        indices = partial_indices(partial, backbone)
        encoded = encode_points(variables, backbone, partial, indices)
        encoded = with_depth(encoded, variables, model, view(batch))
        decoded = decode(variables, backbone, partial, encoded, None, known(batch))
        return decoded.stages[trained]

    return supervised_phase(variables, train, stages, names, phase, training)


def _indices(batch: Batch, partial: Array, model: BackboneConfig) -> EncoderIndices:
    """Those that come with the batch, or else computed here."""
    if batch.indices is None:
        return partial_indices(partial, model)
    return jax.tree.map(lambda rows: jnp.asarray(rows, jnp.int32), batch.indices)


def _from_block(first: int, learned: Variables, kept: Variables) -> Variables:
    """The first tree from an up-sampling block on, the second before it."""
    if not first:
        return learned
    new = {f"block_{i}" for i in range(first, len(kept["decoder"]))}
    decoder = {
        name: (learned if name in new else kept)["decoder"][name]
        for name in kept["decoder"]
    }
    return {**kept, "decoder": decoder}
