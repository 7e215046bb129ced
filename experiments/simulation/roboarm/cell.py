"""The layout of a robot cell, drawn around a trajectory that it must not touch.

World frame: metres, z up, floor at z = 0; the robot stands on the z axis, its base at
`base_height`, on a table or on a pedestal behind a lower table. Boxes and fences stand
where they hide parts of the robot from the camera.
"""

import dataclasses

import numpy as np
import trimesh
from jaxtyping import Float, Float64
from manifold3d import Manifold

from experiments.simulation.raycast import direction
from experiments.simulation.roboarm.clutter import GAP, Bench, draw_clutter
from experiments.simulation.roboarm.furnishings import (
    FIXTURES,
    fixture,
    pedestal,
    table,
    to_mesh,
    upright,
)
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.solids import Rng, Solids, rod
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.framing import camera_axes

CAMERA_DISTANCE = (1.2, 2.5)
_HALF_FIELD = np.radians(27.5)
_FLOOR = 2.5
_TRIES = 40


@dataclasses.dataclass(frozen=True)
class Cell:
    """What stands still in a sequence; `lower` and `upper` bound robot and fixtures."""

    base_height: float
    support: trimesh.Trimesh
    fixtures: trimesh.Trimesh
    clutter: trimesh.Trimesh
    camera: Camera
    lower: Float64[np.ndarray, "3"]
    upper: Float64[np.ndarray, "3"]

    @property
    def floor(self) -> trimesh.Trimesh:
        """A square around the origin at z = 0."""
        corners = _FLOOR * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        return trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)


def make_cell(
    robot: Robot, positions: Float[np.ndarray, "T J"], rng: Rng, camera: Camera
) -> Cell:
    """A cell for a robot that takes these joint positions; `camera` gives the image
    size and field of view, not the pose."""
    sweep = robot.probe_points(positions)
    reach = np.quantile(np.linalg.norm(sweep, axis=-1), 0.99)
    reach = float(np.clip(reach, 0.3, 1.2))
    supports, height, lower, upper = _support(reach, rng)
    top = supports[0].bounding_box()[5]
    if robot.spacer:
        supports.append(rod((0, 0, height), (0, 0, height + robot.spacer), 0.06))
    sweep = sweep + (0, 0, height)
    bench = Bench(sweep.reshape(-1, 3), lower, upper, top)
    fixtures = _fixtures(bench, reach, rng)
    posed = _aim(bench.sweep, rng, camera)
    eye = np.asarray(posed.position)
    clutter = draw_clutter(bench, sweep, robot.probe_weights, eye, rng)
    target = np.concatenate([bench.sweep, *[_corners(solid) for solid in fixtures]])
    return Cell(
        base_height=height,
        support=to_mesh(supports),
        fixtures=to_mesh(fixtures),
        clutter=to_mesh(clutter),
        camera=posed,
        lower=target.min(axis=0) - 2 * GAP,
        upper=target.max(axis=0) + 2 * GAP,
    )


def _support(reach: float, rng: Rng):
    """Solids of table or pedestal and table, the table first; the base's height; and
    the table's corners."""
    height = rng.uniform(0.55, 0.85)
    half = reach * np.array([rng.uniform(0.35, 0.5), rng.uniform(0.4, 0.6)])
    half = np.maximum(half, 0.3)
    if rng.random() < 0.6:
        ahead = np.array([rng.uniform(0.0, half[0] - 0.15), 0.0])
        solids, top = [], height
    else:
        radius = rng.uniform(0.09, 0.13)
        ahead = np.array([2.5 * radius + half[0], rng.uniform(-0.2, 0.2) * reach])
        solids, top = pedestal(height, radius), height - rng.uniform(0.02, 0.2) * reach
    lower, upper = ahead - half, ahead + half
    return table(lower, upper, top) + solids, height, lower, upper


def _fixtures(bench: Bench, reach: float, rng: Rng) -> Solids:
    """One to four fixtures within reach, where the robot leaves room for them."""
    wanted = int(rng.integers(1, 5))
    for _ in range(_TRIES):
        kind = FIXTURES[int(rng.integers(len(FIXTURES)))]
        solid = fixture(kind, reach * rng.uniform(0.12, 0.28), rng)
        place = np.append(rng.uniform(bench.lower, bench.upper), bench.top)
        solid = upright(solid, place, rng.uniform(0, np.pi))
        near = np.linalg.norm(place[:2]) < 0.8 * reach
        if near and bench.holds(solid) and bench.is_clear(solid):
            bench.taken.append(solid)
        if len(bench.taken) == wanted:
            break
    return list(bench.taken)


def _aim(sweep: np.ndarray, rng: Rng, camera: Camera) -> Camera:
    """The camera somewhere around, with as much of the robot in view as it can."""
    lower, upper = np.quantile(sweep, (0.01, 0.99), axis=0)
    center, radius = (lower + upper) / 2, np.linalg.norm(upper - lower) / 2
    distance = rng.uniform(0.8, 1.05) * radius / np.sin(_HALF_FIELD)
    distance = np.clip(distance, *CAMERA_DISTANCE)
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(0.1, 0.6)
    target = center + rng.normal(0, 0.04, 3) * radius
    rotation, translation = look_at(
        center + distance * direction(azimuth, elevation), target
    )
    return dataclasses.replace(
        camera,
        rotation=rotation,
        translation=translation,
        intrinsics=np.asarray(camera.intrinsics, np.float64),
    )


def look_at(
    eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """A camera's rotation and translation, in double precision; z is up."""
    rotation = camera_axes(target - eye)
    return rotation, -rotation @ eye


def _corners(solid: Manifold) -> np.ndarray:
    bounds = np.array(solid.bounding_box())
    return np.stack([bounds[:3], bounds[3:]])
