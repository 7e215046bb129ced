"""What a sensor reads of an object and of what stands around it, ray by ray, and the
maps of what it knows (`geometry.visibility`).

In the object's frame, its longest side spanning [-1, 1]; what goes wrong with a range
is in metres (`sensors.RangeConfig`).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Float64, UInt8

from experiments.simulation.raycast import Hits, Scene, direction
from experiments.simulation.sensors import (
    OusterConfig,
    RangeConfig,
    Rays,
    measure,
    measured_points,
)
from experiments.simulation.surroundings import Surroundings
from prism_jax.geometry.camera import Camera, camera_axes
from prism_jax.geometry.visibility import (
    BACKGROUND,
    MAP_SIZE,
    NEARER,
    SURFACE,
    UNKNOWN,
    Visibility,
)

RAYS = 160 * 160
PIXEL = np.tan(np.radians(35.0)) / 320
"""Tangent of a pixel of a depth camera of 640 pixels over 70 degrees, as the L515's."""


class Readings(NamedTuple):
    """What a sensor knows, ray by ray."""

    state: UInt8[np.ndarray, " N"]  # of the four of `geometry.visibility`
    # Where it was measured; anywhere on the ray where nothing is known.
    points: Float64[np.ndarray, "N 3"]
    # Of the rays that the object alone would stop, those that something else stops.
    hidden_share: float

    @property
    def surface(self) -> "Readings":
        """Those of the object."""
        chosen = self.state == SURFACE
        return self._replace(state=self.state[chosen], points=self.points[chosen])


@dataclasses.dataclass(frozen=True)
class World:
    """An object and what stands around it; `half_extent` is its unit in metres."""

    scene: Scene
    around: Surroundings
    half_extent: float

    def read(
        self, rays: Rays, config: RangeConfig, rng: np.random.Generator
    ) -> Readings:
        """What each ray measures, row by row.

        The returns of the object and those of all else are spoiled apart, as if whoever
        cut the object out had dropped the points that fly between the two.
        """
        grid = rays.directions.shape[0], rays.directions.shape[1]
        directions = rays.directions.reshape(-1, 3)
        own = self.scene.cast(rays.eye, directions)
        other = self.around.cast(rays.eye, directions)
        first = np.full((2, len(directions)), np.inf)
        first[0, own.ray], first[1, other.ray] = own.distances, other.distances
        of_object = first[0] <= first[1]
        hidden = 1 - of_object[own.ray].sum() / max(len(own.ray), 1)

        state, points = np.zeros(len(directions), np.uint8), rays.eye + directions
        for hits, kept in (own, of_object[own.ray]), (other, ~of_object[other.ray]):
            metres = hits._replace(distances=hits.distances * self.half_extent)
            kept_hits = Hits(*(array[kept] for array in metres))
            found, ranges = measure(kept_hits, grid, rng, config)
            points[found.ray] = measured_points(
                rays, found, ranges, config.quantum, self.half_extent
            )
            beyond = np.where(found.faces < 0, BACKGROUND, NEARER)
            state[found.ray] = SURFACE if hits is own else beyond
        return Readings(state, points, float(hidden))


def camera_rays(scene: Scene, eye: Float[np.ndarray, "3"]) -> Rays:
    """The pixels of a depth camera that looks at the object's middle and sees it.

    Of more than `RAYS` of `PIXEL` only every second, third and so on is taken.
    """
    axes = camera_axes(scene.center - eye)
    in_camera = (np.asarray(scene.mesh.vertices) - eye) @ axes.T
    tangents = in_camera[:, :2] / in_camera[:, 2:]
    area = np.prod(np.ptp(tangents, axis=0))
    grid = pixel_grid(tangents, PIXEL * max(1, np.ceil(np.sqrt(area / RAYS) / PIXEL)))
    return Rays(eye, (grid.reshape(-1, 3) @ axes).reshape(grid.shape))


def ring_rays(
    scene: Scene, eye: Float[np.ndarray, "3"], config: OusterConfig, pitch: float
) -> Rays:
    """Of a spinning lidar's beams those that pass the object or close by. It is tilted
    about a level axis until the object's middle is `pitch` radians above its equator.
    """
    right, down, forward = camera_axes(scene.center - eye)
    ahead = np.cos(pitch) * forward + np.sin(pitch) * down
    axis = np.sin(pitch) * forward - np.cos(pitch) * down
    sine = scene.radius / np.linalg.norm(scene.center - eye)
    reach = min(np.arctan(2 * np.tan(np.arcsin(min(sine, 0.9)))), np.radians(80))
    elevations = np.radians(np.linspace(*config.elevation_degrees, config.beams))[::-1]
    elevations = elevations[np.abs(elevations - pitch) <= reach][:, None]
    step = 2 * np.pi / config.columns
    last = int(min(reach / np.cos(pitch), np.pi / 2) / step)
    azimuths = step * np.arange(-last, last + 1)
    axes, beams = np.stack([ahead, -right, axis]), direction(azimuths, elevations)
    return Rays(eye, (beams.reshape(-1, 3) @ axes).reshape(beams.shape))


def pixel_grid(
    tangents: Float[np.ndarray, "N 2"], pitch: float
) -> Float64[np.ndarray, "R C 3"]:
    """Directions (x, y, 1) at the centres of square pixels in the tangents' box."""
    lower, upper = tangents.min(axis=0), tangents.max(axis=0)
    columns, rows = (
        np.arange(low + pitch / 2, high, pitch)
        for low, high in zip(lower, upper, strict=True)
    )
    x, y = np.meshgrid(columns, rows)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


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

    One through which some of the object was measured is `SURFACE`, at the nearest
    depth. Of all others one of whose rays nothing is known is `UNKNOWN`, and so is one
    without rays. What is left is what was nearest. So a thin thing is seen, and no more
    of a pixel is called free than was seen to be.
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
