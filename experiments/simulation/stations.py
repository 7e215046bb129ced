"""Sensors of random kinds at random places around an object.

In the object's frame, z up, its longest side spanning [-1, 1].
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Float64

from experiments.simulation.partials import HALF_EXTENT, random_viewpoint
from experiments.simulation.raycast import Scene
from experiments.simulation.readings import camera_rays, ring_rays
from experiments.simulation.sensors import L515Config, OusterConfig, RangeConfig, Rays

BEAMS: Mapping[int, tuple[float, float]] = {
    16: (-15.0, 15.0),
    32: (-30.67, 10.67),
    64: (-24.9, 2.0),
    128: (-22.5, 22.5),
}
"""Beams of spinning lidars and the degrees they span, as the data sheets of Velodyne's
VLP-16, HDL-32E and HDL-64E and of Ouster's OS1 have it. Evenly spaced here."""
COLUMNS = (1024, 2048)  # of a turn

ELEVATIONS = (-15.0, 75.0)  # degrees of a sensor above the object's middle
CLEARANCE = 1.4
"""No sensor is closer to the object's middle, in radii of its bounding sphere."""
FARTHEST = 7.0  # nor is a camera farther away, in units of the object

CAMERA_METRES, LIDAR_METRES = (0.3, 8.0), (2.0, 20.0)  # from sensor to object
CAMERA_SIDES, LIDAR_SIDES = (0.2, 3.0), (0.5, 5.0)
"""The object's longest side in metres, where the sensor has noise."""


@dataclasses.dataclass(frozen=True)
class Sensor:
    """One kind of sensor, in one place or in several."""

    config: RangeConfig  # an `OusterConfig` is a lidar's
    half_extent: float  # metres that the object's unit stands for
    eyes: tuple[Float64[np.ndarray, "3"], ...]

    @property
    def has_rings(self) -> bool:
        """Whether it is a lidar, whose beams leave gaps."""
        return isinstance(self.config, OusterConfig)

    def rays(
        self, scene: Scene, eye: Float[np.ndarray, "3"], rng: np.random.Generator
    ) -> Rays:
        """Those of the sensor at an eye that may meet the object.

        A camera looks at its middle. A lidar is tilted so that the middle lies anywhere
        in the inner 80 % of what its beams span.
        """
        if not isinstance(self.config, OusterConfig):
            return camera_rays(scene, eye)
        return tilted_rays(scene, eye, self.config, (0.1, 0.9), rng)


def tilted_rays(
    scene: Scene,
    eye: Float[np.ndarray, "3"],
    config: OusterConfig,
    inner: tuple[float, float],
    rng: np.random.Generator,
) -> Rays:
    """`ring_rays` with the object's middle in this inner part of what beams span."""
    low, high = np.radians(config.elevation_degrees)
    return ring_rays(scene, eye, config, low + rng.uniform(*inner) * (high - low))


def random_ouster(
    rng: np.random.Generator, counts: Sequence[int] = tuple(BEAMS)
) -> OusterConfig:
    """A spinning lidar of one of these numbers of beams, with an Ouster's noise."""
    beams, columns = int(rng.choice(counts)), int(rng.choice(COLUMNS))
    return OusterConfig(beams=beams, columns=columns, elevation_degrees=BEAMS[beams])


def random_camera(
    scene: Scene, num_eyes: int, noisy: bool, rng: np.random.Generator
) -> Sensor:
    """A depth camera as an L515: with its noise, of an object of any of `CAMERA_SIDES`,
    or exact."""
    if noisy:
        half_extent = 0.5 * _log_uniform(*CAMERA_SIDES, rng)
        config = L515Config()
    else:
        half_extent, config = HALF_EXTENT, L515Config().exact()
    least, most = (metres / half_extent for metres in CAMERA_METRES)
    eyes = _random_eyes(scene, num_eyes, least, min(most, FARTHEST), rng)
    return Sensor(config, half_extent, eyes)


def random_lidar(scene: Scene, num_eyes: int, rng: np.random.Generator) -> Sensor:
    """A spinning lidar of one of `BEAMS`."""
    half_extent = 0.5 * _log_uniform(*LIDAR_SIDES, rng)
    config = random_ouster(rng)
    least, most = (metres / half_extent for metres in LIDAR_METRES)
    return Sensor(config, half_extent, _random_eyes(scene, num_eyes, least, most, rng))


def _random_eyes(
    scene: Scene, count: int, least: float, most: float, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    least = max(least, CLEARANCE * scene.radius)
    distances = [_log_uniform(least, max(least, most), rng) for _ in range(count)]
    return tuple(
        scene.center + random_viewpoint(rng, ELEVATIONS, (distance, distance))
        for distance in distances
    )


def _log_uniform(low: float, high: float, rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
