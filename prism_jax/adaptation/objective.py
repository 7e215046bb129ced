"""The label-free objective of one cloud, Eq. 11 and Eq. 13."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.adaptation.config import AdaptConfig, PrismConfig
from prism_jax.losses.alignment import alignment_loss
from prism_jax.losses.denoise import denoise_loss
from prism_jax.losses.depth import depth_error
from prism_jax.losses.normal import normal_loss
from prism_jax.losses.weighting import BRANCHES, weighted_auxiliary
from prism_jax.models import prism
from prism_jax.models.variables import Variables


class Losses(NamedTuple):
    """The terms of Eq. 13 as they are, before scales and weights, and their sum."""

    objective: Float[Array, "*steps"]
    depth_consistency: Float[Array, "*steps"]
    normal: Float[Array, "*steps"]
    denoise: Float[Array, "*steps"]
    align: Float[Array, "*steps"]

    @property
    def auxiliary(self) -> Float[Array, "*steps K"]:
        """Those of Eq. 11, in the order of `BRANCHES`."""
        return jnp.stack([getattr(self, name) for name in BRANCHES], -1)


def auxiliary_losses(
    inputs: prism.NetworkInput,
    prediction: prism.Prediction,
    seen: prism.Branches,
    config: AdaptConfig,
) -> Float[Array, "3"]:
    """Eq. 5, 6 and 9 of one cloud, in the order of `BRANCHES`."""
    normal = normal_loss(
        seen.normals,
        prediction.points,
        config.lambda_smooth,
        config.normal_neighbors,
        config.normal_stride,
    )
    moved = inputs.perturbed + seen.offsets
    denoise = denoise_loss(moved, inputs.upsampled, seen.offsets, config.lambda_offset)
    align = alignment_loss(
        seen.tokens_3d,
        seen.tokens_depth,
        config.lambda_sigma,
        config.lambda_transport,
        config.transport_epsilon,
    )
    return jnp.stack([normal, denoise, align])


def test_time_objective(
    variables: Variables, inputs: prism.NetworkInput, config: PrismConfig
) -> tuple[Losses, prism.Prediction]:
    """L_TTA of Eq. 13, its terms, and the prediction that they judge.

    Each auxiliary loss is divided by its scale from training (gap 15) and weighted by
    softmax(eta*). Differentiable in the encoders' parameters.
    """
    prediction = prism.predict(variables, inputs, config.model)
    depth_tokens = prism.read_depth(variables, inputs, config.model)
    seen = prism.branches(variables, inputs, prediction, depth_tokens, config.model)
    auxiliary = auxiliary_losses(inputs, prediction, seen, config.adapt)
    consistency = depth_error(
        prediction.points, inputs.reference, inputs.reference_mask, inputs.view
    )
    settings, weighting = config.adapt, variables["weighting"]
    weighted = weighted_auxiliary(weighting["logits"], auxiliary, weighting["scales"])
    objective = settings.depth_weight * consistency
    if settings.auxiliary_weight:
        objective += settings.auxiliary_weight * weighted
    return Losses(objective, consistency, *auxiliary), prediction
