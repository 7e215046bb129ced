"""Chamfer distance between two point clouds, and its sum over all stages, Eq. 10."""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.geometry.neighbors import nearest

ChamferNorm = Literal["l2", "l1"]

# The floor under a squared distance before its root: the slope of the root stays
# finite, and a point that sits on its neighbour gets no gradient.
SQUARED_DISTANCE_FLOOR = 1e-9


def chamfer(
    prediction: Float[Array, "N 3"],
    target: Float[Array, "M 3"],
    norm: ChamferNorm = "l2",
) -> Float[Array, ""]:
    """Symmetric Chamfer distance, the CD of Eq. 6 and Eq. 10.

    `"l2"`: mean squared distance to the nearest neighbour, summed over both
    directions and not halved. `"l1"`: half the sum of the two mean unsquared
    distances, none of which counts as less than 3.2e-5 (7.8e-3 in float16). These are
    the CD-L2 and CD-L1 of the completion literature.

    Differentiable twice in both clouds, through the nearest neighbours found. Memory is
    linear in the number of points. An empty cloud or an unknown norm raises
    `ValueError`; NaN coordinates give NaN.

    Fan et al., "A Point Set Generation Network for 3D Object Reconstruction from a
    Single Image", CVPR 2017.
    """
    to_target, _ = nearest(prediction, target)
    to_prediction, _ = nearest(target, prediction)
    if norm == "l2":
        return jnp.mean(to_target) + jnp.mean(to_prediction)
    if norm == "l1":
        return 0.5 * (_mean_root(to_target) + _mean_root(to_prediction))
    raise ValueError(f"unknown Chamfer norm {norm!r}: use 'l1' or 'l2'")


def stage_chamfers(
    stages: tuple[Float[Array, "_ 3"], ...],
    complete: Float[Array, "M 3"],
    norm: ChamferNorm = "l2",
) -> Float[Array, " S"]:
    """Chamfer distance of every stage to as many points of the complete cloud.

    `complete` must be in farthest-point order, so that its first N_s points are
    FPS(C, N_s) of Eq. 10. A stage with more points than `complete` is compared
    with all of it. Differentiable like `chamfer`; no stages raise `ValueError`.
    """
    pairs = ((stage, complete[: stage.shape[0]]) for stage in stages)
    return jnp.stack([chamfer(*pair, norm) for pair in pairs])


def primary_loss(
    stages: tuple[Float[Array, "_ 3"], ...],
    complete: Float[Array, "M 3"],
    norm: ChamferNorm = "l2",
) -> Float[Array, ""]:
    """Eq. 10: the sum of the Chamfer distances of all stages, equally weighted. Inputs,
    gradients and faults as in `stage_chamfers`."""
    return jnp.sum(stage_chamfers(stages, complete, norm))


def _mean_root(squared: Float[Array, " N"]) -> Float[Array, ""]:
    # In float16 the floor would round to zero.
    floor = max(SQUARED_DISTANCE_FLOOR, float(jnp.finfo(squared.dtype).tiny))
    return jnp.mean(jnp.sqrt(jnp.maximum(squared, floor)))
