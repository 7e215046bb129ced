"""The completion backbone as functions: encode the partial, decode every stage."""

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from prism_jax.geometry.visibility import Visibility, nothing_known
from prism_jax.models.config import BackboneConfig
from prism_jax.models.decoder import Decoded, Decoder, DecoderIndices
from prism_jax.models.encoder import EncoderIndices, PointEncoder, PointFeatures
from prism_jax.models.variables import Variables, apply, apply_training, on_cpu, part


def init_backbone(key: PRNGKeyArray, config: BackboneConfig) -> Variables:
    """Fresh variables of the encoder and the decoder, made on the CPU, so that a seed
    means the same everywhere."""

    def init(key: PRNGKeyArray) -> Variables:
        keys = jax.random.split(key, 3)
        partial = jax.random.uniform(keys[0], (config.num_points, 3), minval=-1.0)
        known = nothing_known()
        encoded, encoder = PointEncoder(config).init_with_output(keys[1], partial)
        decoder = Decoder(config).init(keys[2], partial, encoded, visibility=known)
        parts = {"point_encoder": encoder, "decoder": decoder}
        return {
            collection: {name: own.get(collection, {}) for name, own in parts.items()}
            for collection in ("params", "batch_stats")
        }

    with on_cpu():
        return jax.jit(init)(key)


def encode_points(
    variables: Variables,
    config: BackboneConfig,
    partial: Float[Array, "... N 3"],
    indices: EncoderIndices | None = None,
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


def train_backbone(
    variables: Variables,
    config: BackboneConfig,
    partial: Float[Array, "B N 3"],
    num_blocks: int | None = None,
    visibility: Visibility | None = None,
) -> tuple[Decoded, Variables]:
    """All stages with statistics of the batch, and the updated running statistics. A
    decoder that reads visibility needs the map."""
    statistics, own = variables["batch_stats"], part(variables, "point_encoder")
    encoded, encoder = apply_training(PointEncoder(config), own, partial)
    own = part(variables, "decoder")
    given = {"num_blocks": num_blocks, "visibility": visibility}
    decoded, decoder = apply_training(Decoder(config), own, partial, encoded, **given)
    decoder = {**statistics["decoder"], **decoder}
    return decoded, {**statistics, "point_encoder": encoder, "decoder": decoder}
