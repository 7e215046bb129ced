"""Maps of what a sensor knows, in 16 bits a pixel.

Two bits hold the state and fourteen the depth, in steps of equal ratio between the
nearest and the farthest depth of the map: a depth is off by less than a part in 8,000
where the farthest is fifty times the nearest.
"""

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
