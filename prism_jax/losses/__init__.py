"""The losses of PRISM, Eq. 3-11: pure functions of one cloud that return a scalar."""

from prism_jax.losses.alignment import (
    alignment_loss,
    manifold_matching,
    transport_alignment,
)
from prism_jax.losses.chamfer import ChamferNorm, chamfer
from prism_jax.losses.denoise import denoise_loss, perturb, upsample_midpoints
from prism_jax.losses.depth import depth_consistency, depth_error, depth_supervised
from prism_jax.losses.normal import normal_loss
from prism_jax.losses.primary import primary_loss, stage_chamfers
from prism_jax.losses.weighting import (
    entropy,
    loss_weights,
    update_scale,
    weighted_auxiliary,
)

__all__ = [
    "ChamferNorm",
    "alignment_loss",
    "chamfer",
    "denoise_loss",
    "depth_consistency",
    "depth_error",
    "depth_supervised",
    "entropy",
    "loss_weights",
    "manifold_matching",
    "normal_loss",
    "perturb",
    "primary_loss",
    "stage_chamfers",
    "transport_alignment",
    "update_scale",
    "upsample_midpoints",
    "weighted_auxiliary",
]
