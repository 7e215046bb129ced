"""Maps of what a sensor knows, in 16 bits a pixel.

Two bits hold the state and fourteen the depth, in steps of equal ratio between the
nearest and the farthest depth of the map: a depth is off by less than a part in 8,000
where the farthest is fifty times the nearest.
"""

import jax
import numpy as np
from jaxtyping import Float32, UInt16

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import UNKNOWN, Visibility

DEPTH_BITS = 14
STEPS = 2**DEPTH_BITS - 1

Pixels = UInt16[np.ndarray, "H W"]
View = Float32[np.ndarray, "18"]
"""Rotation row by row, translation, two focal lengths, the principal point, nearest and
farthest depth."""


def encode(visibility: Visibility) -> tuple[Pixels, View]:
    """One map as it is stored. Its camera has no skew; known depths are positive."""
    camera = jax.tree.map(np.asarray, visibility.camera)
    state = np.asarray(visibility.state)
    depth = np.asarray(visibility.depth, np.float64)
    known = state != UNKNOWN
    near, far = (depth[known].min(), depth[known].max()) if known.any() else (1.0, 1.0)
    # What the reader has, so that the steps are the same.
    near, far = np.float32(near), np.float32(far)
    ratio = np.log(max(far / near, 1 + 1e-6))
    steps = np.log(np.where(known, depth, near) / near) / ratio * STEPS
    steps = np.clip(np.rint(steps), 0, STEPS).astype(np.uint16)
    focal_x, focal_y = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    middle = camera.intrinsics[:2, 2]
    pose = camera.rotation.ravel(), camera.translation
    view = np.concatenate([*pose, [focal_x, focal_y], middle, [near, far]])
    return (state.astype(np.uint16) << DEPTH_BITS) | steps, view.astype(np.float32)


def decode(pixels: Pixels, view: View) -> Visibility:
    """The map that was encoded, in float32."""
    height, width = pixels.shape
    intrinsics = np.eye(3, dtype=np.float32)
    intrinsics[[0, 1], [0, 1]], intrinsics[:2, 2] = view[12:14], view[14:16]
    camera = Camera(view[:9].reshape(3, 3), view[9:12], intrinsics, height, width)
    near, far = view[16:]
    state = (pixels >> DEPTH_BITS).astype(np.uint8)
    ratio = np.log(max(far / near, 1 + 1e-6))
    depth = near * np.exp((pixels & STEPS) * np.float32(ratio / STEPS))
    return Visibility(camera, state, np.where(state == UNKNOWN, 0, depth))
