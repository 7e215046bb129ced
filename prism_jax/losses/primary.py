"""The coarse-to-fine completion loss, Eq. 10."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.losses.chamfer import ChamferNorm, chamfer


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
    if not stages:
        raise ValueError("the primary loss needs at least one stage")
    return jnp.stack(
        [chamfer(stage, complete[: stage.shape[0]], norm) for stage in stages]
    )


def primary_loss(
    stages: tuple[Float[Array, "_ 3"], ...],
    complete: Float[Array, "M 3"],
    norm: ChamferNorm = "l2",
) -> Float[Array, ""]:
    """Eq. 10: the sum of the Chamfer distances of all stages, equally weighted. Inputs,
    gradients and faults as in `stage_chamfers`."""
    return jnp.sum(stage_chamfers(stages, complete, norm))
