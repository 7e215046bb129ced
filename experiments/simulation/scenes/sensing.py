"""What one depth camera or lidar measures of a scene, and what each point is of."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation

from experiments.simulation.kinds import BEAMS, random_ouster, tilted_rays
from experiments.simulation.raycast import Scene, direction
from experiments.simulation.readings import pixel_grid
from experiments.simulation.sensors import (
    L515Config,
    RangeConfig,
    Rays,
    measure,
    measured_points,
)
from prism_jax.geometry.camera import camera_axes
from prism_jax.preprocessing.segmentation.scene import LEFT_OVER

TILTS = (20.0, 60.0)  # degrees by which a sensor looks down

ROLL = 3.0  # standard deviation in degrees, of a camera that somebody holds

AZIMUTHS = 50.0  # degrees to either side of straight on to a wall

HALF_FIELD = np.radians((35.0, 27.5))  # of a depth camera as the L515, across and down

WIDTHS = (320, 640)  # pixels of a depth camera's row

FILLED, CAMERA_METRES = (0.6, 1.2), (0.35, 8.0)
"""A camera's distance, in that at which the things just fill the image; within limits.
"""

LIDAR_BEAMS = tuple(beams for beams in BEAMS if beams >= 32)
LIDAR_RADII, LIDAR_METRES = (1.2, 3.0), (2.0, 12.0)
"""A lidar's distance, in radii of the sphere around all things; within limits."""

STRAY = 4.0  # deviations from the surface: a point farther off flies beside an edge


class PlacedSensor(NamedTuple):
    """A sensor in its place."""

    name: Literal["camera", "lidar"]
    config: RangeConfig
    rotation: Float64[np.ndarray, "3 3"]  # rows: right, down, forward in the world
    rays: Rays  # one for each pixel, or each column and beam near the things


class Measured(NamedTuple):
    """Points in the world, ray by ray, and the label of each."""

    points: Float64[np.ndarray, "N 3"]
    labels: Int[np.ndarray, " N"]


def random_camera(
    things: Scene, faces_wall: bool, heading: float, rng: np.random.Generator
) -> PlacedSensor:
    """An L515 that looks down at things from anywhere around them, or from the side of
    -y, turned by `heading` degrees, where there is a wall behind them."""
    width = int(rng.choice(WIDTHS))
    distance = rng.uniform(*FILLED) * things.radius / np.sin(HALF_FIELD[1])
    eye = _eye(things, distance, CAMERA_METRES, faces_wall, heading, rng)
    roll = Rotation.from_euler("z", rng.normal(scale=ROLL), degrees=True)
    axes = roll.as_matrix() @ camera_axes(things.center - eye)
    across, down = np.tan(HALF_FIELD)
    grid = pixel_grid(np.array([(-across, -down), (across, down)]), 2 * across / width)
    directions = (grid.reshape(-1, 3) @ axes).reshape(grid.shape)
    return PlacedSensor("camera", L515Config(), axes, Rays(eye, directions))


def random_lidar(
    things: Scene, faces_wall: bool, heading: float, rng: np.random.Generator
) -> PlacedSensor:
    """A spinning lidar, tilted so that its beams meet things; of each turn only what
    passes them or close by. Where it stands is as for `random_camera`."""
    config = random_ouster(rng, LIDAR_BEAMS)
    distance = rng.uniform(*LIDAR_RADII) * things.radius
    eye = _eye(things, distance, LIDAR_METRES, faces_wall, heading, rng)
    rays = tilted_rays(things, eye, config, (0.3, 0.7), rng)
    return PlacedSensor("lidar", config, camera_axes(things.center - eye), rays)


def _eye(
    things: Scene,
    distance: float,
    limits: tuple[float, float],
    faces_wall: bool,
    heading: float,
    rng: np.random.Generator,
) -> np.ndarray:
    spread = AZIMUTHS if faces_wall else 180.0
    azimuth = np.radians(heading - 90.0 + rng.uniform(-spread, spread))
    tilt = np.radians(rng.uniform(*TILTS))
    return things.center + np.clip(distance, *limits) * direction(azimuth, tilt)


def measured(
    scene: Scene,
    owners: Int[np.ndarray, " F"],
    sensor: PlacedSensor,
    rng: np.random.Generator,
) -> Measured:
    """What the sensor measures of a scene whose faces have these labels. A point that
    flies beside an edge belongs to nothing."""
    rays, config = sensor.rays, sensor.config
    grid = rays.directions.shape[0], rays.directions.shape[1]
    directions = rays.directions.reshape(-1, 3)
    hits, ranges = measure(scene.cast(rays.eye, directions), grid, rng, config)
    points = measured_points(rays, hits, ranges, config.quantum)
    noise = np.interp(hits.distances, *np.array(config.noise).T)
    strays = np.abs(ranges - hits.distances) > STRAY * noise + config.quantum
    return Measured(points, np.where(strays, LEFT_OVER, owners[hits.faces]))
