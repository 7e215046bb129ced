"""Maps of what a simulated sensor knows (`geometry.visibility`)."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from experiments.simulation.readings import Readings
from experiments.simulation.sensors import Rays
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import MAP_SIZE, SURFACE, UNKNOWN, Visibility


def map_rays(camera: Camera, eye: Float[np.ndarray, "3"]) -> Rays:
    """Five through every pixel of `framing_camera`: its middle and its corners."""
    middles = np.arange(MAP_SIZE) - 0.5 * (MAP_SIZE - 1)
    # Just inside, or rounding decides whose corners they are.
    x, y = 0.499 * np.array([(0, 0), (-1, -1), (1, -1), (-1, 1), (1, 1)]).T
    shape = MAP_SIZE, MAP_SIZE, len(x)
    columns = np.broadcast_to(middles[:, None] + x, shape)
    rows = np.broadcast_to(middles[:, None, None] + y, shape)
    focal = camera.intrinsics[0, 0]
    rays = np.stack([columns, rows, np.full(shape, focal)], axis=-1) / focal
    return Rays(eye, rays.reshape(MAP_SIZE, -1, 3) @ np.asarray(camera.rotation))


def map_of(camera: Camera, parts: Sequence[Readings]) -> Visibility:
    """Each pixel by what the rays through it read, in float32.

    One through which some of the object was measured is `SURFACE`, at the nearest depth
    that it was measured at. Of all others one of whose rays nothing is known is
    `UNKNOWN`, and so is one without rays. What is left is what was nearest. So a thin
    thing is seen, and no more of a pixel is called free than was seen to be.
    """
    state = np.concatenate([readings.state for readings in parts])
    pixel, depth = camera.pixel_of(np.concatenate([part.points for part in parts]))
    depth = np.where(state == UNKNOWN, 0.0, depth)
    # The last of those that fall on a pixel stays.
    order = np.lexsort((-depth, state == UNKNOWN, state == SURFACE))
    order = order[pixel[order] < MAP_SIZE**2]
    states, depths = np.zeros(MAP_SIZE**2, np.uint8), np.zeros(MAP_SIZE**2, np.float32)
    states[pixel[order]], depths[pixel[order]] = state[order], depth[order]
    shape = MAP_SIZE, MAP_SIZE
    camera = jax.tree.map(lambda array: np.asarray(array, np.float32), camera)
    return Visibility(camera, states.reshape(shape), depths.reshape(shape))
