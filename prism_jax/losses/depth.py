"""Projection-based depth losses, Eq. 3 and Eq. 4."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.render import render_depth

EPSILON = 1e-8


def depth_supervised(
    predicted: Float[Array, "N 3"], complete: Float[Array, "M 3"], camera: Camera
) -> Float[Array, ""]:
    """Eq. 3: mean depth error against the rendered ground-truth complete cloud.

    In the unit of the points. Gradients reach the front-most points of `predicted`
    only. No shared pixel gives zero, with zero gradients.
    """
    return depth_error(predicted, *render_depth(complete, camera), camera)


def depth_error(
    predicted: Float[Array, "N 3"],
    reference_depth: Float[Array, "H W"],
    reference_mask: Bool[Array, "H W"],
    camera: Camera,
) -> Float[Array, ""]:
    """Mean |D_pred - D_ref| over the pixels valid in both: Eq. 4, if the reference is
    the rendered partial, which is rendered once for all steps.

    Otherwise as `depth_supervised`. What stands in `reference_depth` outside its mask
    has no influence, NaN included. No gradient reaches the reference.
    """
    depth, mask = render_depth(predicted, camera)
    shared = mask & reference_mask
    reference = jnp.where(shared, jax.lax.stop_gradient(reference_depth), 0.0)
    error = jnp.abs(jnp.where(shared, depth, 0.0) - reference)
    return jnp.sum(error) / (jnp.sum(shared) + EPSILON)
