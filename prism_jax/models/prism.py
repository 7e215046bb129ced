"""PRISM's two streams and its auxiliary branches, as functions of their variables."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.render import render_depth
from prism_jax.geometry.visibility import Visibility, seen_by
from prism_jax.losses.denoise import perturb, upsample_midpoints
from prism_jax.models import auxiliary, backbone
from prism_jax.models.config import ModelConfig
from prism_jax.models.decoder import Decoded, DecoderIndices
from prism_jax.models.depth_encoder import DepthEncoder
from prism_jax.models.encoder import EncoderIndices, PointFeatures, encoder_indices
from prism_jax.models.variables import Variables, apply, part


class NetworkInput(NamedTuple):
    """One partial cloud and its view, and all that follows from them alone: computed
    once for all adaptation steps."""

    partial: Float[Array, "N 3"]  # measured points in the unit workspace
    indices: EncoderIndices  # samples and neighbours of the point encoder
    # What the depth stream reads, relative to the workspace centre.
    depth: Float[Array, "H W"]
    depth_mask: Bool[Array, "H W"]
    view: Camera  # the camera at the resolution of Eq. 3 and 4
    # The partial's depth map in that view.
    reference: Float[Array, "h w"]
    reference_mask: Bool[Array, "h w"]
    # A(P) of Eq. 6 and its neighbour graph.
    perturbed: Float[Array, "N 3"]
    perturbed_neighbors: Int[Array, "N k"]
    upsampled: Float[Array, "M 3"]  # U(P) of Eq. 6
    # Samples and neighbours of the decoder, where they are held.
    decoding: DecoderIndices | None = None
    # What the sensor knows, for networks that read it.
    visibility: Visibility | None = None


class Prediction(NamedTuple):
    """A completion: the refined points, the decoder's stages and last features. Of one
    cloud, or of a batch."""

    points: Float[Array, "... N 3"]
    stages: tuple[Float[Array, "... _ 3"], ...]
    features: Float[Array, "... N C"]
    encoded: PointFeatures


class Branches(NamedTuple):
    """What the auxiliary losses look at."""

    normals: Float[Array, "N 3"]
    offsets: Float[Array, "P 3"]
    tokens_3d: Float[Array, "m d"]
    tokens_depth: Float[Array, "n d"]


def prepare_input(
    partial: Float[Array, "N 3"],
    camera: Camera,
    key: PRNGKeyArray,
    config: ModelConfig,
    visibility: Visibility | None = None,
) -> NetworkInput:
    """What the network reads of a partial cloud and its camera, in the unit workspace.

    A network that reads `visibility` derives it from the cloud if it is None
    (`prism_jax.geometry.visibility.seen_by`). No gradient reaches cloud or camera.
    """
    partial, camera = jax.lax.stop_gradient((partial, camera))
    if not config.backbone.reads_visibility:
        visibility = None
    elif visibility is None:
        visibility = seen_by(partial, camera.position, config.background)
    pixels = config.depth_pixels
    depth, mask = render_depth(partial, camera.resized(pixels, pixels))
    center_depth = camera.to_camera(jnp.zeros((1, 3)))[0, 2]
    view = camera.resized(config.consistency_pixels, config.consistency_pixels)
    perturbed = perturb(key, partial, camera.position)
    return NetworkInput(
        partial,
        encoder_indices(partial, config.backbone),
        jnp.where(mask, depth - center_depth, 0.0),
        mask,
        view,
        *render_depth(partial, view),
        perturbed,
        knn(perturbed, perturbed, config.auxiliary.denoise_neighbors),
        upsample_midpoints(partial),
        visibility=visibility,
    )


def hold_decoding(
    variables: Variables, inputs: NetworkInput, config: ModelConfig
) -> NetworkInput:
    """The inputs with the samples and neighbours that these variables decode them by.

    The completion is then a continuous function of the encoders. Otherwise the losses
    of Eq. 13 jump by more than a gradient step lowers them.
    """
    encoded = encode(variables, inputs, config)
    return inputs._replace(decoding=decode(variables, inputs, encoded, config).indices)


def predict(
    variables: Variables, inputs: NetworkInput, config: ModelConfig
) -> Prediction:
    """Encode, decode, refine (Eq. 2)."""
    encoded = encode(variables, inputs, config)
    return decode_and_refine(variables, inputs, encoded, config)


def encode(
    variables: Variables, inputs: NetworkInput, config: ModelConfig
) -> PointFeatures:
    """The point stream."""
    own = inputs.partial, inputs.indices
    return backbone.encode_points(variables, config.backbone, *own)


def decode_and_refine(
    variables: Variables,
    inputs: NetworkInput,
    encoded: PointFeatures,
    config: ModelConfig,
) -> Prediction:
    """The stages and the refined points. A batch is one pass through the decoder."""
    decoded = decode(variables, inputs, encoded, config)
    points = refine(variables, decoded, config)
    return Prediction(points, decoded.stages, decoded.features, encoded)


def decode(
    variables: Variables,
    inputs: NetworkInput,
    encoded: PointFeatures,
    config: ModelConfig,
) -> Decoded:
    """All stages, by what is held of an earlier decoding."""
    given = inputs.partial, encoded, inputs.decoding, inputs.visibility
    return backbone.decode(variables, config.backbone, *given)


def refine(
    variables: Variables, decoded: Decoded | Prediction, config: ModelConfig
) -> Float[Array, "... N 3"]:
    """The last stage's points as the refiner leaves them (Eq. 2)."""
    own, refiner = part(variables, "refiner"), auxiliary.Refiner(config.auxiliary)
    return apply(refiner, own, decoded.stages[-1], decoded.features)


def read_depth(
    variables: Variables, inputs: NetworkInput, config: ModelConfig
) -> Float[Array, "... n C"]:
    """The depth stream's tokens, with BatchNorm statistics as they are."""
    own, encoder = part(variables, "depth_encoder"), DepthEncoder(config.auxiliary)
    return apply(encoder, own, inputs.depth, inputs.depth_mask)


def branches(
    variables: Variables,
    inputs: NetworkInput,
    prediction: Prediction,
    depth_tokens: Float[Array, "n C"],
    config: ModelConfig,
) -> Branches:
    """What the auxiliary modules make of a prediction."""

    def read(module: nn.Module, *arguments: Any) -> Any:
        own = part(variables, "auxiliary", str(module.name))
        return apply(module, own, *arguments)

    return run_auxiliary(read, inputs, prediction, depth_tokens, config)


def run_auxiliary(
    read: Callable[..., Any],
    inputs: NetworkInput,
    prediction: Prediction,
    depth_tokens: Float[Array, "n C"],
    config: ModelConfig,
) -> Branches:
    """Gives each auxiliary module, in the order of `init_auxiliary` and by the name of
    its variables, what it looks at: ``read(module, *arguments)`` is what it makes."""
    sizes, perturbed = config.auxiliary, (inputs.perturbed, inputs.perturbed_neighbors)
    integrator = auxiliary.TokenIntegrator(sizes, name="integrator")
    tokens, latent = read(integrator, prediction.encoded)
    projection = auxiliary.DepthProjection(sizes, name="projection")
    tokens_depth = read(projection, depth_tokens)
    completed = prediction.points, prediction.features
    return Branches(
        read(auxiliary.NormalHead(sizes, name="normal"), *completed),
        read(auxiliary.Denoiser(sizes, name="denoiser"), *perturbed, latent),
        tokens,
        tokens_depth,
    )
