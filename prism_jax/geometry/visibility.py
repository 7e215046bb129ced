"""What a view knows: where it measured a surface, what hides it, where it is empty.

A lost return says nothing. What is not known is never free.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, UInt8

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.precision import exact_products
from prism_jax.geometry.workspace import Workspace

UNKNOWN, SURFACE, NEARER, BACKGROUND = range(4)
"""States of a pixel. Nothing was measured; the object was; something nearer was, which
hides all behind it; or the sensor looked past the object, to what lies beyond."""

MAP_SIZE = 64
"""Pixels of the side of the maps that are made and stored."""


class Visibility(NamedTuple):
    """A map of what one sensor knows, in the frame and the unit of its clouds.

    Attributes:
      camera: the view whose pixels these are, from where the sensor stood.
      state: one of the four states of each pixel.
      depth: along the camera's z, of what was measured there; 0 where the state is
        `UNKNOWN`. In every other state all that is nearer is free.
    """

    camera: Camera
    state: UInt8[Array | np.ndarray, "*batch H W"]
    depth: Float32[Array | np.ndarray, "*batch H W"]


def look_up(
    visibility: Visibility, points: Float[Array | np.ndarray, "N 3"]
) -> tuple[UInt8[Array | np.ndarray, " N"], Float[Array | np.ndarray, " N"]]:
    """What the map says of points: the state of each one's pixel, and how far behind
    what was measured there it lies.

    Negative is in front of it, and so in free space. Points that have no image are
    `UNKNOWN`, and of what is unknown the depth behind is 0. Differentiable in points,
    pose and measured depth, but for the choice of the pixel. One map and one cloud, in
    one frame and unit; NumPy arrays stay NumPy.
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


def to_unit(visibility: Visibility, workspace: Workspace) -> Visibility:
    """The same of points in the unit of a workspace."""
    camera = workspace.camera_to_unit(visibility.camera)
    return Visibility(
        camera, visibility.state, visibility.depth / workspace.half_extent
    )


def mirrored(visibility: Visibility) -> Visibility:
    """The same of the mirror image along x, of clouds and sensor.

    The camera's rotation stays one: the image's columns change places instead. Of one
    map, or of several with leading axes.
    """
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
    camera = Camera(
        rotation=np.eye(3, dtype=np.float32),
        translation=np.zeros(3, np.float32),
        intrinsics=np.eye(3, dtype=np.float32),
        height=size,
        width=size,
    )
    shape = size, size
    return Visibility(camera, np.zeros(shape, np.uint8), np.zeros(shape, np.float32))
