"""The completion backbone as functions: encode the partial, decode every stage."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import Visibility, nothing_known
from prism_jax.models.config import BackboneConfig, ModelConfig
from prism_jax.models.decoder import Decoded, Decoder, DecoderIndices
from prism_jax.models.depth_encoder import DepthEncoder, DepthView
from prism_jax.models.encoder import (
    EncoderIndices,
    PointEncoder,
    PointFeatures,
    encoder_indices,
)
from prism_jax.models.layers import over_batch
from prism_jax.models.variables import Variables, apply, apply_training, part


class RenderedView(NamedTuple):
    """What the depth stream reads of a cloud, and the view that it is of."""

    camera: Camera
    depth: Float[Array, "... H W"]
    mask: Bool[Array, "... H W"]


def init_backbone(
    key: PRNGKeyArray, config: BackboneConfig, model: ModelConfig | None = None
) -> Variables:
    """Fresh variables of the encoder and the decoder, and of the depth stream for a
    decoder that reads it, whose sizes are the model's."""

    def init(key: PRNGKeyArray) -> Variables:
        keys = jax.random.split(key, 3)
        shape = (1, config.num_points, 3)
        partial = jax.random.uniform(keys[0], shape, minval=-1.0)
        indices = partial_indices(partial, config)
        known = nothing_of(partial) if config.reads_visibility else None
        given = {"visibility": known}
        encoder = PointEncoder(config).init(keys[1], partial, indices, **given)
        encoded = PointEncoder(config).apply(encoder, partial, indices, **given)
        parts = {"point_encoder": encoder}
        if config.reads_depth:
            assert model is not None
            side = model.depth_pixels
            image = jnp.zeros((1, side, side))
            module = DepthEncoder(model.auxiliary)
            parts["depth_encoder"] = module.init(keys[0], image, image > 0)
            maps = module.apply(parts["depth_encoder"], image, image > 0).maps
            camera = Camera.fixed_view()
            camera = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], camera)
            encoded = encoded._replace(depth=DepthView(camera, maps))
        decoder = Decoder(config).init(keys[2], partial, encoded, visibility=known)
        parts["decoder"] = decoder
        return {
            collection: {name: own.get(collection, {}) for name, own in parts.items()}
            for collection in ("params", "batch_stats")
        }

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
    visibility: Visibility | None = None,
    view: RenderedView | None = None,
    model: ModelConfig | None = None,
) -> PointFeatures:
    """The point stream, with BatchNorm statistics as they are, and the depth stream for
    a decoder that reads it."""
    own = part(variables, "point_encoder")
    given = {"visibility": visibility}
    encoded = apply(PointEncoder(config), own, partial, indices, **given)
    if not config.reads_depth:
        return encoded
    own = part(variables, "depth_encoder")
    seen = apply(DepthEncoder(model.auxiliary), own, view.depth, view.mask)
    return encoded._replace(depth=DepthView(view.camera, seen.maps))


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
    config: BackboneConfig,
    partial: Float[Array, "B N 3"],
    indices: EncoderIndices,
    num_blocks: int | None = None,
    visibility: Visibility | None = None,
    view: RenderedView | None = None,
    model: ModelConfig | None = None,
) -> tuple[Decoded, Variables]:
    """All stages with statistics of the batch, and the updated running statistics."""
    encoded, encoder = apply_training(
        PointEncoder(config),
        part(variables, "point_encoder"),
        partial,
        indices,
        visibility=visibility,
    )
    streams = {"point_encoder": encoder}
    if config.reads_depth:
        seen, streams["depth_encoder"] = apply_training(
            DepthEncoder(model.auxiliary),
            part(variables, "depth_encoder"),
            view.depth,
            view.mask,
        )
        encoded = encoded._replace(depth=DepthView(view.camera, seen.maps))
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
        **streams,
        "decoder": {**variables["batch_stats"]["decoder"], **decoder},
    }
    return decoded, statistics
