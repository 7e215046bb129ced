"""One frame in several poses, and what a network makes of each, brought back."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import Visibility, mirrored, seen_by, turned
from prism_jax.models.config import ModelConfig
from prism_jax.models.prism import NetworkInput, predict, prepare_input
from prism_jax.models.variables import Variables
from prism_jax.preprocessing.observation import framed_view

_QUARTER_TURN = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
POSES = np.array([np.eye(3), np.diag([-1, 1, 1]), _QUARTER_TURN], np.float32)
"""As it is, its mirror image in x, and a quarter turn about the vertical. They take
columns."""

posed = functools.partial(jnp.einsum, precision="highest")


def seen_in(
    pose: Float[np.ndarray, "3 3"],
    partial: Float[Array, "N 3"],
    eye: Float[Array, "3"],
    visibility: Visibility | None,
    config: ModelConfig,
) -> Visibility | None:
    """Visibility of a cloud that lies in one of `POSES` already, for a network that
    reads it, from that of the cloud as it was or else from the posed cloud."""
    if not config.backbone.reads_visibility:
        return None
    if visibility is None:
        return seen_by(partial, eye, config.background)
    if np.linalg.det(pose) > 0:
        return turned(visibility, pose.T)
    return mirrored(turned(visibility, (POSES[1] @ pose).T))


def in_other_poses(
    partial: Float[Array, "N 3"],
    camera: Camera,
    key: Array,
    config: ModelConfig,
    visibility: Visibility | None = None,
) -> NetworkInput:
    """Inputs of a frame in the first ``config.poses`` of `POSES` but the first, side by
    side. Arguments are those of `prepare_input`."""
    poses = POSES[1 : config.poses]
    clouds = posed("nj,pij->pni", partial, poses)
    eyes = posed("j,pij->pi", camera.position, poses)
    maps = [
        seen_in(pose, clouds[i], eyes[i], visibility, config)
        for i, pose in enumerate(poses)
    ]

    def one(cloud: Array, eye: Array, visibility: Visibility | None) -> NetworkInput:
        view = framed_view(cloud, eye)
        return prepare_input(cloud, view, key, config, visibility=visibility)

    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *maps)
    return jax.vmap(one)(clouds, eyes, stacked)


def to_original_frame(
    variables: Variables, inputs: NetworkInput, config: ModelConfig, first: int = 1
) -> tuple[Float[Array, "P 3"], Float[Array, " G"]]:
    """The completions of a frame in `POSES` from the ``first`` on, as `in_other_poses`
    has them, one behind the other in the frame as it was; and the global feature of the
    first of them. One pass, differentiable in the variables."""
    found = jax.vmap(lambda each: predict(variables, each, config))(inputs)
    back = posed("pni,pij->pnj", found.points, POSES[first : config.poses])
    return back.reshape(-1, 3), found.encoded.global_feature[0]
