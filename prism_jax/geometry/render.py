"""Depth rendering of point clouds by z-buffering (PRISM, Eq. 1)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from prism_jax.geometry.camera import Camera


def render_depth(
    points: Float[Array, "N 3"], camera: Camera
) -> tuple[Float[Array, "H W"], Bool[Array, "H W"]]:
    """Nearest depth per pixel, and which pixels any point falls on (Eq. 1).

    Depth is the camera-frame z in the points' units, and 0 where the mask is False.
    Points behind the camera, outside the image or not finite are dropped; if none is
    left the mask is all False and every gradient is zero.

    Differentiable in the points and the camera's pose, through the depth of the
    nearest point of each pixel alone (equal nearest points share it): where a point
    falls and which point wins are constants, so moving sideways has no gradient
    except as it changes z.
    """
    pixel, z = camera.pixel_of(points)
    num_pixels = camera.height * camera.width
    nearest = jnp.full(num_pixels, jnp.inf, z.dtype)
    # "drop", not "clip": a clipped index gives infinite gradients.
    nearest = nearest.at[pixel].min(z, mode="drop")
    mask = jnp.isfinite(nearest)
    depth = jnp.where(mask, nearest, 0.0)
    shape = (camera.height, camera.width)
    return depth.reshape(shape), mask.reshape(shape)
