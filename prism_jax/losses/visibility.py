"""Losses of what a view knows: where it is empty nothing is, and what was right stays.

Neither needs a truth. They stand beside Eq. 4, which compares depths where both clouds
have a pixel and says nothing of emptiness.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from prism_jax.geometry.neighbors import nearest
from prism_jax.geometry.visibility import (
    BACKGROUND,
    Visibility,
    beside,
    free_depth,
    look_up,
)


def visibility_loss(
    points: Float[Array, "N 3"],
    visibility: Visibility,
    tolerance: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Mean over the points of `contradiction`: zero if the view allows them all."""
    return jnp.mean(contradiction(points, visibility, tolerance))


def contradiction(
    points: Float[Array, "N 3"],
    visibility: Visibility,
    tolerance: Float[Array, ""] | float,
) -> Float[Array, " N"]:
    """Squared way of each point out of the space that the sensor saw to be free.

    A point in front of all that was measured about its pixel
    (`prism_jax.geometry.visibility.free_depth`), an object's surface or something
    nearer, would have hidden it: its way is along the optical axis, to `tolerance` in
    front of that. One before the background lies outside the object's outline: its way
    is the shorter one, aside to the outline (`prism_jax.geometry.visibility.beside`) or
    back to what was measured. Nothing is held against a point where nothing was
    measured, behind what was, beside the image, behind the camera, or not finite.

    One map and one cloud in one frame; `tolerance` is in their unit, the result in its
    square. Differentiable in the points but at the borders of pixels, where the
    measured depth jumps. No gradient reaches the map.
    """
    visibility = jax.lax.stop_gradient(visibility)
    free = visibility._replace(depth=free_depth(visibility))
    state, behind = look_up(free, points)
    # Behind is 0 where nothing is known, so nothing is known to be in front.
    way = jnp.maximum(-behind - tolerance, 0.0)
    before = state == BACKGROUND
    # A point that is not finite would have a gradient that is not, either.
    aside = beside(visibility, jnp.where(before[:, None], points, 0.0))
    return jnp.where(before, jnp.minimum(way, aside), way) ** 2


def keep_loss(
    points: Float[Array, "N 3"],
    kept: Float[Array, "M 3"],
    mask: Bool[Array, " M"],
) -> Float[Array, ""]:
    """Mean squared distance from those of `kept` that the mask marks to the points.

    With the points that an unadapted completion has right in `kept`, adaptation pays
    for leaving them uncovered. Differentiable in the points, through the nearest one of
    each; none reaches `kept`. Zero, with zero gradients, if none is marked. Coordinates
    must be finite; no points at all raise ValueError.
    """
    apart, _ = nearest(jax.lax.stop_gradient(kept), points)
    return jnp.sum(jnp.where(mask, apart, 0.0)) / jnp.maximum(jnp.sum(mask), 1)
