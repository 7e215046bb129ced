"""What a learned loss looks at: label-free geometry of each predicted point.

From it a small network tells how far the point lies from the true surface
(`prism_jax.models.error_head`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.geometry.neighbors import knn, nearest
from prism_jax.geometry.visibility import Visibility, clues, spacing_of

NAMES = (
    "measured",  # logarithm of the distance from the nearest measured point
    "measured_8",  # and from the eighth nearest
    "predicted",  # logarithm of the distance from the nearest other predicted point
    "predicted_8",  # and from the eighth
    "bulge",  # logarithm of the distance from the mean of those eight
    "unknown",  # how much of each state is about its pixel
    "surface",
    "nearer",
    "background",
    "behind",  # how far behind what was measured there, negative in front
    "aside",  # distance of its line of sight from the silhouette
    "x",  # place in the workspace
    "y",
    "z",
    "centre",  # distance from the workspace's centre
    "outside",  # of the box of what was measured
    "ray_x",  # direction in which the sensor sees it
    "ray_y",
    "ray_z",
    "range",  # and how far away
    "spacing",  # logarithm of that of the measured points
)
"""The numbers of each point, in their order. Lengths are in half sides of the
workspace; `MIDDLE` is taken from logarithms."""

NEIGHBORS = 8
"""Of a predicted point, besides itself."""

FLOOR = 0.01
"""Half sides of the workspace: about a third of the spacing of the network's input.
Lengths are rounded off there, so that those of copies have a derivative."""

MIDDLE = -3.0
"""A usual logarithm of an error, in half sides of the workspace."""

REACH = 4.0
"""Half sides of the workspace: coordinates beyond are taken for as much."""


def error_clues(
    points: Float[Array, "N 3"],
    partial: Float[Array, "M 3"],
    visibility: Visibility,
    eye: Float[Array, "3"],
) -> Float[Array, "N C"]:
    """What of each predicted point speaks for or against it, by `NAMES`.

    Points, measured partial, what the sensor knows and its place, in the unit
    workspace; at least one point and one measured one. Continuous in the points but
    where a neighbour makes room for another, differentiable almost everywhere and
    smooth where points fall together; every derivative is finite. No gradient reaches
    partial, map or eye. A point that is not finite counts as one in the middle of the
    workspace, and has none.
    """
    known = jax.lax.stop_gradient((partial, visibility, eye))
    partial, visibility, eye = known
    finite = jnp.isfinite(points).all(-1, keepdims=True)
    points = jnp.clip(jnp.where(finite, points, 0.0), -REACH, REACH)
    away = partial[knn(points, partial, NEIGHBORS)[:, -1]]
    around = points[knn(points, points, NEIGHBORS + 1)[:, 1:]]
    lower, upper = partial.min(0), partial.max(0)
    beyond = jnp.maximum(lower - points, 0.0) + jnp.maximum(points - upper, 0.0)
    ray = points - eye
    length = jnp.sqrt(_squared(ray) + FLOOR**2)
    logarithms = (
        nearest(points, partial)[0],
        _squared(points - away),
        _squared(points - around[:, 0]),
        _squared(points - around[:, -1]),
        _squared(points - around.mean(1)),
    )
    columns = (
        *(_logarithm(squared) for squared in logarithms),
        *clues(visibility, points).T,
        *points.T,
        jnp.sqrt(_squared(points) + FLOOR**2),
        jnp.sqrt(_squared(beyond) + FLOOR**2),
        *(ray / length[:, None]).T,
        length,
        jnp.full(len(points), _logarithm(spacing_of(partial) ** 2)),
    )
    return jnp.stack(columns, axis=-1)


def _squared(vectors: Float[Array, "N 3"]) -> Float[Array, " N"]:
    return (vectors**2).sum(-1)


def _logarithm(squared: Float[Array, "..."]) -> Float[Array, "..."]:
    return 0.5 * jnp.log(squared + FLOOR**2) - MIDDLE
