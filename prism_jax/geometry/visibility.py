"""Visibility: where a view measured a surface, what hides it, where it is empty.

A lost return says nothing. What is not known is never free. NumPy arrays stay NumPy
where both kinds are allowed.
"""

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, UInt8

from prism_jax.geometry.camera import MIN_DEPTH, Camera, Vector, camera_axes
from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.precision import exact_products
from prism_jax.geometry.render import render_depth

UNKNOWN, SURFACE, NEARER, BACKGROUND = range(4)
"""States of a pixel: nothing was measured; the object was; something nearer was, which
hides all behind it; or what lies beyond the object."""

MAP_SIZE = 64  # pixels of the side of the maps that are made and stored
MAP_MARGIN = 1.4  # of a map around the object's points: it sees past the silhouette
WIDEST = np.tan(np.deg2rad(60.0))  # a tangent: `Camera.framing` sees to it at each side
CLOSED = 3.0  # in spacings of the points: holes in a cloud that are no wider are closed

Background = Literal["unknown", "empty"]
"""What lies around a cloud in its sensor's view: nobody knows, or nothing was hit."""


class Visibility(NamedTuple):
    """A map of what one sensor measured, in the frame and the unit of its clouds."""

    camera: Camera  # the view whose pixels these are, from where the sensor stood
    # One of the four states of each pixel.
    state: UInt8[Array | np.ndarray, "*batch H W"]
    # Along the camera's z, of what was measured there; 0 where the state is `UNKNOWN`.
    # In every other state all that is nearer is free.
    depth: Float32[Array | np.ndarray, "*batch H W"]


def look_up(
    visibility: Visibility, points: Float[Array | np.ndarray, "N 3"]
) -> tuple[UInt8[Array | np.ndarray, " N"], Float[Array | np.ndarray, " N"]]:
    """What the map says of points: the state of each one's pixel, and how far behind
    what was measured there it lies (negative in front, and so in free space).

    Points that have no image are `UNKNOWN`, and of what is unknown the depth behind is
    0. Differentiable in points, pose and depth, but for the choice of the pixel.
    """
    leaves = jax.tree.leaves((visibility, points))
    xp: Any = jnp if any(isinstance(leaf, jax.Array) for leaf in leaves) else np
    pixel, z = visibility.camera.pixel_of(points)
    # One more pixel, for what has no image.
    padded = (xp.pad(rows.ravel(), (0, 1)) for rows in map(xp.asarray, visibility[1:]))
    state, depth = (rows[pixel] for rows in padded)
    return state, xp.where(state == UNKNOWN, 0.0, z - depth).astype(z.dtype)


@exact_products
def turned(
    visibility: Visibility, turn: Float[Array | np.ndarray, "3 3"]
) -> Visibility:
    """The same of points, as rows, that are turned: ``points @ turn``."""
    camera = visibility.camera
    camera = dataclasses.replace(camera, rotation=camera.rotation @ turn)
    return visibility._replace(camera=camera)


def mirrored(visibility: Visibility) -> Visibility:
    """The same of the mirror image along x, of clouds and sensor. The camera's rotation
    stays one: the image's columns change places instead. Any leading axes."""
    camera = visibility.camera
    flip = np.array([-1, 1, 1], np.float32)
    # u becomes width - 1 - u: the skew changes its sign, and so does the middle.
    signs = np.array([[1, -1, -1], [1, 1, 1], [1, 1, 1]], np.float32)
    shift = np.zeros((3, 3), np.float32)
    shift[0, 2] = camera.width - 1
    camera = dataclasses.replace(
        camera,
        rotation=camera.rotation * flip * flip[:, None],
        translation=camera.translation * flip,
        intrinsics=camera.intrinsics * signs + shift,
    )
    return Visibility(camera, visibility.state[..., ::-1], visibility.depth[..., ::-1])


def nothing_known(size: int = MAP_SIZE) -> Visibility:
    """A square map that knows nothing, for views of which none was kept."""
    axes, shape = np.eye(3, dtype=np.float32), (size, size)
    camera = Camera(axes, np.zeros(3, np.float32), axes, *shape)
    return Visibility(camera, np.zeros(shape, np.uint8), np.zeros(shape, np.float32))


def framing_camera(
    points: Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"],
    widest: float = np.inf,
) -> Camera:
    """The camera of a map of `MAP_SIZE` that a cloud fills with `MAP_MARGIN`, at either
    side to the tangent `widest` at most: to that, if points are beside or behind it. As
    `Camera.framing`, in float64 and without JAX."""
    axes = camera_axes(0.5 * (points.min(axis=0) + points.max(axis=0)) - eye)
    in_camera = (points - eye) @ axes.T
    tangent = widest
    if (in_camera[:, 2] > MIN_DEPTH).all():
        tangent = MAP_MARGIN * np.abs(in_camera[:, :2] / in_camera[:, 2:]).max()
    tangent = min(max(tangent, 1e-3), widest)
    focal, middle = 0.5 * MAP_SIZE / tangent, 0.5 * (MAP_SIZE - 1)
    intrinsics = np.array([(focal, 0, middle), (0, focal, middle), (0, 0, 1)])
    return Camera(axes, -axes @ eye, intrinsics, MAP_SIZE, MAP_SIZE)


def seen_by(
    points: Float[Array, "N 3"], eye: Vector, background: Background = "unknown"
) -> Visibility:
    """What a cloud says by itself of the view of the sensor at `eye`.

    Where points fall is their surface, nearest depth first, and so are the holes
    between them: what is no wider than `CLOSED` spacings, the median distance of the
    points from their nearest neighbours, at their mean distance from the eye. All else
    is `UNKNOWN`; or, if the `background` is "empty", `BACKGROUND` at twice the depth
    of the farthest point: nothing else was hit around the object.

    A square map of `MAP_SIZE`, filled by the points with `MAP_MARGIN`, in their frame
    and unit. Points are finite and at least two. No gradient passes.
    """
    points = jax.lax.stop_gradient(points)
    camera = Camera.framing(points, eye, MAP_MARGIN, MAP_SIZE, MAP_SIZE)
    depth, hit = render_depth(points, camera)
    z = camera.to_camera(points)[:, 2]
    near = points[knn(points, points, 2)[:, 1]]
    spacing = jnp.median(jnp.linalg.norm(points - near, axis=1))
    focal = camera.intrinsics[0, 0]
    reach = 0.5 * CLOSED * spacing * focal / jnp.maximum(z.mean(), MIN_DEPTH)
    # Within the margin, or the image's edge would be part of a hole.
    reach = jnp.minimum(reach, MAP_SIZE / 8)
    surface, nearest = closed(hit, reach)
    around, beyond = UNKNOWN, 0.0
    if background == "empty":
        around, beyond = BACKGROUND, 2.0 * z.max()
    depth = jnp.where(surface, depth.ravel()[nearest], beyond)
    state = jnp.where(surface, SURFACE, around)
    return Visibility(camera, state.astype(jnp.uint8), depth)


def closed(
    marked: Bool[Array | np.ndarray, "H W"], reach: Float[Array, ""] | float
) -> tuple[Bool[Array | np.ndarray, "H W"], Int[Array | np.ndarray, "H W"]]:
    """The marked pixels and the holes between them that are at most twice as wide as
    the reach in pixels, and the marked pixel that is nearest to each. The image's edge
    counts as marked."""
    apart, nearest = nearest_marked(marked)
    return marked | (nearest_marked(apart > reach)[0] > reach), nearest


def nearest_marked(
    marked: Bool[Array | np.ndarray, "H W"],
) -> tuple[Float[Array | np.ndarray, "H W"], Int[Array | np.ndarray, "H W"]]:
    """How far each pixel lies from the nearest marked one, in pixels, and which it is;
    infinitely, where none is marked."""
    xp: Any = jnp if isinstance(marked, jax.Array) else np
    height, width = marked.shape
    rows, columns = xp.arange(height), xp.arange(width)
    away = xp.square(rows[:, None] - rows)[:, :, None]
    away = xp.where(marked, away.astype(float), xp.inf)  # (to, from, column)
    row, within = away.argmin(1), away.min(1)
    aside = xp.square(columns[:, None] - columns)
    total = within[:, None, :] + aside  # (row, to, from)
    column = total.argmin(2)
    nearest = xp.take_along_axis(row, column, 1) * width + column
    return xp.sqrt(total.min(2)), nearest


def visibility_features(
    visibility: Visibility, points: Float[Array, "N 3"]
) -> Float[Array, "N 6"]:
    """What the map says of points, as numbers that a network reads.

    In turn: how much of each of the four states is there; how far the point lies behind
    what was measured, negative in front, weighted by how much is known; and how far
    aside of the measured surface, at the point's depth. Both lengths are bounded to
    [-1, 1] and 1. Between the middles of four pixels everything is interpolated, so it
    is continuous, and differentiable almost everywhere. Beside the image, and for
    points that are not in front of the camera, all is unknown; there, and without any
    surface, a point is as many pixels aside as the image is high. One map and one cloud
    in the unit workspace.
    """
    camera, (state, depth) = visibility.camera, map(jnp.asarray, visibility[1:])
    shares = jax.nn.one_hot(state, 4)
    aside = jnp.minimum(nearest_marked(state == SURFACE)[0], camera.height)
    channels = [shares, depth[..., None] * (state != UNKNOWN)[..., None]]
    image = jnp.concatenate([*channels, aside[..., None]], axis=-1)
    beyond = jnp.array([1.0, 0, 0, 0, 0, camera.height])
    uv, z = camera.project(points)
    read = interpolated(image, uv, beyond)
    read = jnp.where((z > MIN_DEPTH)[:, None], read, beyond)
    known = 1.0 - read[:, UNKNOWN]
    behind = jnp.clip(known * z - read[:, 4], -1.0, 1.0)
    away = jnp.minimum(read[:, 5] * z / camera.intrinsics[0, 0], 1.0)
    away = jnp.where(z > MIN_DEPTH, away, 1.0)
    return jnp.concatenate([read[:, :4], behind[:, None], away[:, None]], axis=1)


def interpolated(
    image: Float[Array, "H W C"], uv: Float[Array, "N 2"], beyond: Float[Array, " C"]
) -> Float[Array, "N C"]:
    """Bilinear between the middles of pixels; `beyond` is what lies around them."""
    height, width, _ = image.shape
    padded = jnp.pad(image - beyond, ((1, 1), (1, 1), (0, 0))) + beyond
    # In the coordinates of the padded image; farther out it is the same.
    u = jnp.clip(uv[:, 0] + 1.0, 0.0, width + 1.0)
    v = jnp.clip(uv[:, 1] + 1.0, 0.0, height + 1.0)
    left = jnp.clip(jnp.floor(u), 0, width).astype(int)
    top = jnp.clip(jnp.floor(v), 0, height).astype(int)
    right, down = (u - left)[:, None], (v - top)[:, None]
    above = padded[top, left] * (1 - right) + padded[top, left + 1] * right
    below = padded[top + 1, left] * (1 - right) + padded[top + 1, left + 1] * right
    return above * (1 - down) + below * down
