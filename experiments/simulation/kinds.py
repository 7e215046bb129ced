"""Partial views by the name of their kind, with what their sensor knows of the rest.

The kinds of `partials` are points alone. Those made here are named after what they
have, several things joined by plus signs:

    clear      what one exact depth camera sees, with nothing in the way
    occluded   something stands between sensor and object
    truncated  the image's edge or somebody's workspace cuts the object off
    rings      a spinning lidar of 16 to 128 beams, metres away
    noisy      a depth camera with the noise of an L515, objects of 0.2 to 3 m
    stations   the object is seen from two to four places

All stand on a floor, before a wall, or in the open, at random.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from experiments.simulation.partials import (
    HALF_EXTENT,
    PARTIALS,
    make_partial,
    random_viewpoint,
)
from experiments.simulation.raycast import Scene
from experiments.simulation.readings import (
    World,
    camera_rays,
    map_of,
    map_rays,
    ring_rays,
)
from experiments.simulation.sensors import L515Config, OusterConfig, RangeConfig, Rays
from experiments.simulation.surroundings import (
    HIDDEN_SHARES,
    Surroundings,
    random_occluder,
    random_planes,
)
from experiments.simulation.truncation import NO_CUT, random_cut
from prism_jax.geometry.visibility import Visibility, framing_camera

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
CLEARANCE = 1.4  # least distance from the object's middle, in radii of its sphere
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
        half_extent, config = 0.5 * _log_uniform(*CAMERA_SIDES, rng), L515Config()
    else:
        half_extent, config = HALF_EXTENT, L515Config().exact()
    least, most = (metres / half_extent for metres in CAMERA_METRES)
    eyes = _random_eyes(scene, num_eyes, least, min(most, FARTHEST), rng)
    return Sensor(config, half_extent, eyes)


def random_lidar(scene: Scene, num_eyes: int, rng: np.random.Generator) -> Sensor:
    """A spinning lidar of one of `BEAMS`."""
    half_extent, config = 0.5 * _log_uniform(*LIDAR_SIDES, rng), random_ouster(rng)
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


MIXTURE: Mapping[str, float] = {
    "clear": 0.10,
    "occluded": 0.14,
    "truncated": 0.12,
    "rings": 0.12,
    "noisy": 0.10,
    "stations": 0.08,
    "occluded+truncated": 0.06,
    "occluded+rings": 0.04,
    "occluded+noisy": 0.10,
    "truncated+noisy": 0.08,
    "occluded+truncated+noisy": 0.04,
    "noisy+stations": 0.02,
}
"""How often "mixed" draws each kind."""

KINDS = (*PARTIALS, *MIXTURE, "mixed")  # what a data set can be asked for


def has_maps(kind: str) -> bool:
    """Whether views of a kind come with what their sensor knows."""
    return kind not in PARTIALS


EVERY = 4  # one ray in so many, each way, tells whether an occluder stands in the way


class View(NamedTuple):
    """What was measured of an object."""

    points: Float64[np.ndarray, "N 3"]  # not resampled; there may be none
    eye: Float64[np.ndarray, "3"]  # of several stations, the one that saw most
    kind: str  # one of `KINDS`, but not "mixed"
    visibility: Visibility | None = None  # at `eye`; None for the kinds of `partials`


def draw_kind(rng: np.random.Generator, mixture: Mapping[str, float] = MIXTURE) -> str:
    """A kind at random, by weights that need not sum to one."""
    weights = np.array(list(mixture.values()))
    return str(rng.choice(list(mixture), p=weights / weights.sum()))


def make_view(
    kind: str,
    scene: Scene,
    complete: Float[np.ndarray, "M 3"],
    rng: np.random.Generator,
    num_points: int,
) -> View:
    """One view of a kind that is not "mixed"; scene and cloud as for `make_partial`.

    A view that came to nothing, being out of range or hidden too much or too little,
    has no points. An unknown kind raises ValueError.
    """
    if kind in PARTIALS:
        return View(*make_partial(kind, scene, complete, rng, num_points), kind)
    if kind not in MIXTURE:
        known = (*PARTIALS, *MIXTURE)
        raise ValueError(f"unknown kind {kind!r}: choose one of {known}")
    sensed = _sensed(kind.split("+"), scene, rng)
    if sensed is None:
        return View(np.zeros((0, 3)), np.zeros(3), kind)
    points, eye, visibility = sensed
    return View(points, eye, kind, visibility)


def _sensed(
    traits: Sequence[str],
    scene: Scene,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, Visibility] | None:
    """Points, eye and map of a view that has these traits."""
    num_eyes = int(rng.integers(2, 5)) if "stations" in traits else 1
    if "rings" in traits:
        sensor = random_lidar(scene, num_eyes, rng)
    else:
        sensor = random_camera(scene, num_eyes, "noisy" in traits, rng)
    world = _random_world(traits, scene, sensor, rng)
    if world is None:
        return None
    found = [
        world.read(sensor.rays(scene, eye, rng), sensor.config, rng)
        for eye in sensor.eyes
    ]
    first, seen = sensor.eyes[0], found[0].surface.points
    least, most = HIDDEN_SHARES if "occluded" in traits else (0.0, 1.0)
    if not (least <= found[0].hidden_share <= most and len(seen)):
        return None
    cut = random_cut(scene, first, seen, rng) if "truncated" in traits else NO_CUT
    found = [cut.apply(*pair) for pair in zip(found, sensor.eyes, strict=True)]
    measured = [readings.surface for readings in found]
    points = np.concatenate([readings.points for readings in measured])
    best = int(np.argmax([len(readings.points) for readings in measured]))
    eye = sensor.eyes[best]
    camera = framing_camera(points, eye)
    if sensor.has_rings:
        return points, eye, map_of(camera, [found[best]])
    unmixed = dataclasses.replace(sensor.config, mixed_share=0.0)
    own = cut.apply(world.read(map_rays(camera, eye), unmixed, rng), eye)
    return points, eye, map_of(camera, [own, measured[best]])


def _random_world(
    traits: Sequence[str],
    scene: Scene,
    sensor: Sensor,
    rng: np.random.Generator,
) -> World | None:
    """None where nothing was found to stand in the way of the first eye."""
    around = Surroundings(planes=random_planes(scene, sensor.eyes, rng))
    if "occluded" in traits:
        eye, directions = camera_rays(scene, sensor.eyes[0])
        few = directions[::EVERY, ::EVERY].reshape(-1, 3)
        occluder = random_occluder(eye, scene.cast(eye, few).points, rng, scene.mesh)
        if occluder is None:
            return None
        around = around._replace(occluders=occluder)
    return World(scene, around, sensor.half_extent)
