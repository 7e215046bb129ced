"""Ground truth: what an Ouster gathers of robot and fixtures from all around.

The cell stands still and its boxes and fences are taken away meanwhile. From each
station the sensor turns `TURNS` times and the ranges of a beam are averaged, which
leaves an eighth of one turn's noise. Beams on depth edges are not mixed: silhouettes
are cleaner than a real sensor's. Every station is outside the surveyed parts' bounding
sphere, so a point that returns is one that is seen from outside: nothing behind a
closed shell gets into the cloud.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float64

from experiments.simulation.raycast import Scene, direction
from experiments.simulation.sensors import OusterConfig, ouster_scan
from prism_jax.data.ordering import farthest_point_order

TURNS = 64
NOISE_LEFT = 1 / np.sqrt(TURNS)
SURVEY = dataclasses.replace(
    OusterConfig(),
    columns=2048,
    noise=tuple((r, s * NOISE_LEFT) for r, s in OusterConfig().noise),
    mixed_share=0.0,
)
NUM_STATIONS = 10
MAX_ROUNDS = 4


def survey(
    scene: Scene,
    wanted: Bool[np.ndarray, " F"],
    num_points: int,
    rng: np.random.Generator,
    glossy: Bool[np.ndarray, " F"] | None = None,
    config: OusterConfig = SURVEY,
    num_stations: int = NUM_STATIONS,
) -> Float64[np.ndarray, "num_points 3"]:
    """The wanted faces' points in farthest-point order, as many as asked for.

    Rounds of the stations, the sensor turned a little in each, are made until there are
    enough returns; after `MAX_ROUNDS` the order is repeated cyclically. A scene that
    returns nothing raises ValueError.
    """
    corners = scene.triangles[wanted].reshape(-1, 3)
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    center, radius = (lower + upper) / 2, float(np.linalg.norm(upper - lower) / 2)
    gathered, count = [], 0
    for _ in range(MAX_ROUNDS):
        for position, rotation in _stations(center, radius, num_stations, rng):
            returns = ouster_scan(scene, position, rng, config, rotation, glossy)
            gathered.append(returns.points[wanted[returns.faces]])
            count += len(gathered[-1])
        if count >= 1.5 * num_points:
            break
    return farthest_point_order(np.concatenate(gathered), num_points)


def _stations(center, radius: float, count: int, rng: np.random.Generator):
    """Positions around the centre, in turn low, level and high, the sensor's horizon
    through the centre, rolled about that axis at random."""
    start = rng.uniform(0, 2 * np.pi)
    for index in range(count):
        azimuth = start + 2 * np.pi * (index + rng.uniform(-0.2, 0.2)) / count
        elevation = (-0.3, 0.25, 0.8)[index % 3] + rng.uniform(-0.1, 0.1)
        away = rng.uniform(1.3, 1.6) * radius
        position = center + away * direction(azimuth, elevation)
        position[2] = max(position[2], 0.15)
        forward = center - position
        forward /= np.linalg.norm(forward)
        side = np.cross((0.0, 0.0, 1.0), forward)
        side /= np.linalg.norm(side)
        up, roll = np.cross(forward, side), rng.uniform(-0.3, 0.3)
        turned = np.cos(roll) * side + np.sin(roll) * up
        yield position, np.stack([forward, turned, np.cross(forward, turned)], axis=1)
