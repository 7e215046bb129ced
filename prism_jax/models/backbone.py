"""The completion backbone as functions: encode the partial, decode every stage."""

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from prism_jax.geometry.visibility import Visibility, nothing_known
from prism_jax.models.config import BackboneConfig, ModelConfig
from prism_jax.models.decoder import Decoded, Decoder, DecoderIndices
from prism_jax.models.encoder import (
    EncoderIndices,
    PointEncoder,
    PointFeatures,
    encoder_indices,
)
from prism_jax.models.layers import over_batch
from prism_jax.models.variables import (
    Variables,
    apply,
    apply_training,
    on_cpu,
    part,
)


def init_backbone(key: PRNGKeyArray, model: ModelConfig) -> Variables:
    """Fresh variables of the encoder and the decoder, made on the CPU, so that a seed
    means the same everywhere."""
    config = model.backbone

    def init(key: PRNGKeyArray) -> Variables:
        keys = jax.random.split(key, 3)
        shape = (1, config.num_points, 3)
        partial = jax.random.uniform(keys[0], shape, minval=-1.0)
        indices = partial_indices(partial, config)
        encoder = PointEncoder(config).init(keys[1], partial, indices)
        encoded = PointEncoder(config).apply(encoder, partial, indices)
        known = nothing_of(partial) if config.reads_visibility else None
        parts = {"point_encoder": encoder}
        parts["decoder"] = Decoder(config).init(
            keys[2], partial, encoded, visibility=known
        )
        return {
            collection: {name: own.get(collection, {}) for name, own in parts.items()}
            for collection in ("params", "batch_stats")
        }

    with on_cpu():
        return jax.jit(init)(key)


def partial_indices(
    partial: Float[Array, "... N 3"], config: BackboneConfig
) -> EncoderIndices:
    """`encoder_indices` for any leading axes."""
    return over_batch(lambda cloud: encoder_indices(cloud, config))(partial)


def encode_points(
    variables: Variables,
    config: BackboneConfig,
    partial: Float[Array, "... N 3"],
    indices: EncoderIndices,
) -> PointFeatures:
    """The point stream, with BatchNorm statistics as they are."""
    own = part(variables, "point_encoder")
    return apply(PointEncoder(config), own, partial, indices)


def decode(
    variables: Variables,
    config: BackboneConfig,
    partial: Float[Array, "... N 3"],
    encoded: PointFeatures,
    indices: DecoderIndices | None = None,
    visibility: Visibility | None = None,
) -> Decoded:
    """All stages, with BatchNorm statistics as they are."""
    own = part(variables, "decoder")
    given = {"indices": indices, "visibility": visibility}
    return apply(Decoder(config), own, partial, encoded, **given)


def nothing_of(partial: Float[Array, "*B N 3"]) -> Visibility:
    """A map that knows nothing for each cloud."""
    batch = partial.shape[:-2]
    return jax.tree.map(
        lambda leaf: np.broadcast_to(leaf, (*batch, *leaf.shape)), nothing_known()
    )


def train_backbone(
    variables: Variables,
    model: ModelConfig,
    partial: Float[Array, "B N 3"],
    indices: EncoderIndices,
    num_blocks: int | None = None,
    visibility: Visibility | None = None,
) -> tuple[Decoded, Variables]:
    """All stages with statistics of the batch, and the updated running statistics. A
    decoder that reads visibility needs the map."""
    config, updated = model.backbone, {}
    encoded, updated["point_encoder"] = apply_training(
        PointEncoder(config),
        part(variables, "point_encoder"),
        partial,
        indices,
    )
    decoded, decoder = apply_training(
        Decoder(config),
        part(variables, "decoder"),
        partial,
        encoded,
        num_blocks=num_blocks,
        visibility=visibility,
    )
    statistics = {
        **variables["batch_stats"],
        **updated,
        "decoder": {**variables["batch_stats"]["decoder"], **decoder},
    }
    return decoded, statistics
