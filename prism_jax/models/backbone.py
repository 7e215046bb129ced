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
from prism_jax.models.variables import (
    Variables,
    apply,
    apply_training,
    on_cpu,
    part,
)


class RenderedView(NamedTuple):
    """What the depth stream reads of a cloud, and the view that it is of."""

    camera: Camera
    depth: Float[Array, "... H W"]
    mask: Bool[Array, "... H W"]


def init_backbone(key: PRNGKeyArray, model: ModelConfig) -> Variables:
    """Fresh variables of the encoder and the decoder, and of the depth stream if the
    decoder reads it; made on the CPU, so that a seed means the same everywhere."""
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
        if config.reads_depth:
            module = DepthEncoder(model.auxiliary)
            empty = jnp.zeros((1, model.depth_pixels, model.depth_pixels))
            seen, parts["depth_encoder"] = module.init_with_output(
                jax.random.fold_in(key, 3), empty, empty > 0
            )
            camera = jax.tree.map(lambda leaf: leaf[None], Camera.fixed_view())
            encoded = encoded._replace(depth=DepthView(camera, seen.maps))
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


def with_depth(
    encoded: PointFeatures,
    variables: Variables,
    model: ModelConfig,
    view: RenderedView | None,
) -> PointFeatures:
    """The same with the depth stream's maps of a view, BatchNorm statistics as they
    are, if the decoder reads them. It needs a view then."""
    if not model.backbone.reads_depth:
        return encoded
    assert view is not None
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
    model: ModelConfig,
    partial: Float[Array, "B N 3"],
    indices: EncoderIndices,
    num_blocks: int | None = None,
    visibility: Visibility | None = None,
    view: RenderedView | None = None,
) -> tuple[Decoded, Variables]:
    """All stages with statistics of the batch, and the updated running statistics. What
    the decoder reads beside the cloud is given: the map, the view, or both."""
    config, updated = model.backbone, {}
    encoded, updated["point_encoder"] = apply_training(
        PointEncoder(config),
        part(variables, "point_encoder"),
        partial,
        indices,
    )
    if config.reads_depth:
        assert view is not None
        seen, updated["depth_encoder"] = apply_training(
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
        **updated,
        "decoder": {**variables["batch_stats"]["decoder"], **decoder},
    }
    return decoded, statistics
