"""What two depth sensors measure of a mesh: an Intel RealSense L515 and an Ouster OS1.

Both cast one ray a pixel or beam and then spoil the exact range in the same four ways:
mixed pixels at depth edges, noise along the ray, lost returns, quantisation. Metres.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int32, UInt16

from experiments.simulation.raycast import Hits, Scene, direction
from prism_jax.geometry.camera import Camera


@dataclasses.dataclass(frozen=True)
class RangeConfig:
    """What goes wrong with a range that is measured along a ray; by default an L515's.

    Three losses are independent: `dropout`, at grazing angles between ray and normal,
    and on glossy faces, which mirror the beam away. A footprint straddles an edge where
    the exact range of one of the four neighbouring pixels or beams differs by more than
    `edge_step`; its range then may lie anywhere between the two surfaces, uniformly.
    """

    min_range: float = 0.25  # ranges outside these two are no returns
    max_range: float = 9.0
    quantum: float = 0.00025
    # (range, standard deviation along the ray), linear in between, constant beyond
    noise: tuple[tuple[float, float], ...] = ((1.0, 0.0025), (9.0, 0.0155))
    dropout: float = 0.005
    # Shares that grow linearly from 0 between two angles, and stay beyond.
    grazing_degrees: tuple[float, float] = (65.0, 88.0)
    grazing_dropout: float = 1.0
    gloss_degrees: tuple[float, float] = (10.0, 45.0)
    gloss_dropout: float = 0.9
    edge_step: float = 0.05
    mixed_share: float = 0.25  # of the footprints across an edge

    def exact(self):
        """The same sensor without noise, lost returns or mixed pixels."""
        shares = "dropout", "grazing_dropout", "gloss_dropout", "mixed_share"
        return dataclasses.replace(
            self, noise=((0.0, 0.0),), **dict.fromkeys(shares, 0.0)
        )


@dataclasses.dataclass(frozen=True)
class L515Config(RangeConfig):
    """Intel RealSense L515.

    Range 0.25 to 9 m, depth in counts of 0.25 mm, and a depth error of 2.5 mm standard
    deviation at 1 m and 15.5 mm at 9 m on a target of 95 % reflectivity, as Intel's
    maintainers give it (librealsense, issue 5808), beside a mean error of 5 mm and
    14 mm that is not modelled. The shares of lost and mixed pixels are our assumption.
    """


@dataclasses.dataclass(frozen=True)
class OusterConfig(RangeConfig):
    """Ouster OS1: 128 evenly spaced beams over 45 degrees, 1,024 columns a turn.

    Beams, columns and the standard deviation of 1.5 cm where the signal is strong and 3
    cm where it is weaker (signal to noise 100) are the OS1 data sheet's; at which
    ranges is our reading. So are the shares of lost and mixed returns: a beam 0.18
    degrees wide covers half the pitch of 0.35, so half the beams beside an edge touch
    it. The beams' offsets from the axis of rotation, some centimetres, are not
    modelled.
    """

    beams: int = 128
    columns: int = 1024
    elevation_degrees: tuple[float, float] = (-22.5, 22.5)
    min_range: float = 0.3
    max_range: float = 100.0
    quantum: float = 0.001
    noise: tuple[tuple[float, float], ...] = ((20.0, 0.015), (100.0, 0.03))
    grazing_degrees: tuple[float, float] = (70.0, 89.0)
    edge_step: float = 0.1
    mixed_share: float = 0.5


class Rays(NamedTuple):
    """A grid of rays from one place. Directions are as long as one unit of what the
    sensor counts: of depth along the optical axis for a camera, of range for a lidar.
    """

    eye: Float64[np.ndarray, "3"]
    directions: Float64[np.ndarray, "R C 3"]


class Returns(NamedTuple):
    """Points in the world frame, the faces they were measured on, and their ranges."""

    points: Float64[np.ndarray, "R 3"]
    faces: Int[np.ndarray, " R"]
    ranges: Float64[np.ndarray, " R"]


def l515_camera(axes: Float[np.ndarray, "3 3"], eye: Float[np.ndarray, "3"]) -> Camera:
    """The nominal depth view of an Intel RealSense L515, of NumPy arrays: processes
    that only make data start no device. Rows of `axes` are right, down and forward."""
    height, width = 480, 640
    return Camera(
        rotation=axes,
        translation=-axes @ eye,
        intrinsics=np.array(
            [
                [0.5 * width / np.tan(np.radians(35.0)), 0.0, 0.5 * (width - 1)],
                [0.0, 0.5 * height / np.tan(np.radians(27.5)), 0.5 * (height - 1)],
                [0.0, 0.0, 1.0],
            ]
        ),
        height=height,
        width=width,
    )


def cropped_to(camera: Camera, points: Float[np.ndarray, "N 3"]) -> Camera:
    """The part of a camera's image that holds the points, which are in front of it; one
    pixel at least."""
    pixels = np.asarray(camera.to_camera(points)) @ np.asarray(camera.intrinsics).T
    pixels = pixels[:, :2] / pixels[:, 2:]
    size = np.array([camera.width, camera.height])
    first = np.clip(np.floor(pixels.min(axis=0)), 0, size - 1).astype(int)
    last = np.clip(np.ceil(pixels.max(axis=0)), first, size - 1).astype(int)
    intrinsics = np.array(camera.intrinsics)
    intrinsics[:2, 2] -= first
    width, height = (int(extent) for extent in last - first + 1)
    return dataclasses.replace(
        camera, intrinsics=intrinsics, height=height, width=width
    )


def l515_depth(
    scene: Scene,
    camera: Camera,
    rng: np.random.Generator,
    config: L515Config = L515Config(),
    glossy: Bool[np.ndarray, " F"] | None = None,
) -> tuple[UInt16[np.ndarray, "H W"], Int32[np.ndarray, "H W"]]:
    """A depth image in counts of `config.quantum`, and the face behind each pixel.

    Depth is along the camera's +z and is what is quantised; noise and the limits of
    range apply along the ray. 0 is no return, and its face is -1. A mixed pixel names
    the face that its centre sees.
    """
    height, width, rays = camera.height, camera.width, pixel_rays(camera)
    rotation = np.asarray(camera.rotation, np.float64)
    hits = scene.cast(-np.asarray(camera.translation, np.float64) @ rotation, rays)
    hits, ranges = measure(hits, (height, width), rng, config, glossy)
    depth = ranges / np.linalg.norm(rays[hits.ray], axis=1)
    counts = np.zeros(height * width, np.uint16)
    faces = np.full(height * width, -1, np.int32)
    counts[hits.ray] = np.rint(depth / config.quantum)
    faces[hits.ray] = hits.faces
    return counts.reshape(height, width), faces.reshape(height, width)


def pixel_rays(camera: Camera) -> Float64[np.ndarray, "P 3"]:
    """The rays of all pixels, row by row, one unit of depth long."""
    rotation = np.asarray(camera.rotation, np.float64)
    # Broadcast sums: a threaded product with a 3x3 matrix is far slower.
    inverse = np.linalg.inv(np.asarray(camera.intrinsics, np.float64))
    right, down, corner = inverse.T @ rotation
    columns = np.arange(camera.width)[:, None]
    rows = np.arange(camera.height)[:, None, None]
    return (rows * down + (columns * right + corner)).reshape(-1, 3)


def ouster_scan(
    scene: Scene,
    position: Float[np.ndarray, "3"],
    rng: np.random.Generator,
    config: OusterConfig = OusterConfig(),
    rotation: Float[np.ndarray, "3 3"] = np.eye(3),
    glossy: Bool[np.ndarray, " F"] | None = None,
) -> Returns:
    """One turn of the sensor: its returns beam by beam from the top, by azimuth.

    `rotation` takes the sensor's axes (it turns about its z; column 0 looks along x)
    to the world's. What is quantised is the range. The scene is in metres.
    """
    directions = np.einsum("rj,ij->ri", _beam_directions(config), rotation)
    hits = scene.cast(position, directions)
    grid = (config.beams, config.columns)
    hits, ranges = measure(hits, grid, rng, config, glossy, wraps=True)
    ranges = np.rint(ranges / config.quantum) * config.quantum
    points = position + directions[hits.ray] * ranges[:, None]
    return Returns(points, hits.faces, ranges)


@functools.lru_cache(maxsize=4)
def _beam_directions(config: OusterConfig) -> np.ndarray:
    lowest, highest = np.radians(config.elevation_degrees)
    elevation = np.linspace(highest, lowest, config.beams)[:, None]
    azimuth = 2 * np.pi * np.arange(config.columns) / config.columns
    directions = direction(azimuth, elevation).reshape(-1, 3)
    directions.flags.writeable = False
    return directions


def measure(
    hits: Hits,
    grid: tuple[int, int],
    rng: np.random.Generator,
    config: RangeConfig,
    glossy: Bool[np.ndarray, " F"] | None = None,
    wraps: bool = False,
) -> tuple[Hits, Float64[np.ndarray, " R"]]:
    """The hits that return something, and the ranges measured, not yet quantised.

    Hits are of a `grid` of rays, row by row, whose columns close up where it `wraps`;
    their distances are in metres. `glossy` tells which faces of the scene are.
    """
    step = np.zeros(len(hits.ray))
    if config.mixed_share > 0:
        step = _step_to_neighbours(hits, grid, wraps)
    mixed = np.abs(step) > config.edge_step
    mixed &= rng.random(len(step)) < config.mixed_share
    ranges = hits.distances + mixed * rng.random(len(step)) * step
    deviation = np.interp(ranges, *np.array(config.noise).T)
    ranges = ranges + deviation * rng.standard_normal(len(ranges))

    degrees, kept = np.degrees(np.arccos(hits.cosines)), 1 - config.dropout
    kept *= 1 - np.interp(degrees, config.grazing_degrees, (0, config.grazing_dropout))
    if glossy is not None:
        mirrored = np.interp(degrees, config.gloss_degrees, (0, config.gloss_dropout))
        kept *= 1 - glossy[hits.faces] * mirrored
    returned = rng.random(len(ranges)) < kept
    returned &= (ranges >= config.min_range) & (ranges <= config.max_range)
    return Hits(*(array[returned] for array in hits)), ranges[returned]


def measured_points(
    rays: Rays, hits: Hits, ranges: np.ndarray, quantum: float, unit: float = 1.0
) -> Float64[np.ndarray, "R 3"]:
    """Where ranges in metres are, rounded to what a sensor counts; in units of so many
    metres."""
    along = rays.directions.reshape(-1, 3)[hits.ray]
    steps = np.linalg.norm(along, axis=1) * quantum
    return rays.eye + (np.rint(ranges / steps) * quantum / unit)[:, None] * along


def _step_to_neighbours(hits: Hits, grid: tuple[int, int], wraps: bool) -> np.ndarray:
    """How much farther each hit's most different neighbour of four is (or nearer). One
    that hit nothing, or lies outside the grid, does not count."""
    padded = np.full((grid[0] + 2, grid[1] + 2), np.nan)
    inner = padded[1:-1, 1:-1]
    rows, columns = np.divmod(hits.ray, grid[1])
    inner[rows, columns] = hits.distances
    if wraps:
        padded[:, 0], padded[:, -1] = padded[:, -2], padded[:, 1]
    largest = np.zeros(len(hits.ray))
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        step = padded[rows + 1 + down, columns + 1 + right] - hits.distances
        larger = np.abs(step) > np.abs(largest)
        largest[larger] = step[larger]
    return largest
