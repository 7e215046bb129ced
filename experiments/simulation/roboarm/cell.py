"""The layout of a robot cell, drawn around a trajectory that it must not touch.

World frame: metres, z up, floor at z = 0; the robot stands on the z axis, its base at
`base_height`, on a table or on a pedestal behind a lower table. Boxes, screens and
fences stand where they hide parts of the robot from the camera.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float64
from manifold3d import Manifold

from experiments.simulation.raycast import Scene, direction
from experiments.simulation.roboarm.furnishings import (
    FIXTURES,
    fence,
    fixture,
    pedestal,
    table,
    to_mesh,
    upright,
)
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.solids import Rng, Solids, box, rod
from prism_jax.geometry.camera import Camera, camera_axes

HIDDEN_SHARE = (0.2, 0.5)
"""Of the robot's surface, over a sequence, that clutter is to hide from the camera."""
HIDDEN_IN_A_FRAME = (0.08, 0.65)  # of the same, in every single frame
GAP = 0.05  # metres that everything keeps from the robot's sampled points
ROOM = 0.3  # metres that everything keeps from the camera
_CLUTTER_TRIES = 120


class Bench:
    """The table's top, what stands on it, and whether a solid finds room."""

    def __init__(self, sweep, lower, upper, top: float):
        self.sweep, self.lower, self.upper, self.top = sweep, lower, upper, top
        self.taken: Solids = []

    def holds(self, solid: Manifold) -> bool:
        """Whether a solid's box lies over the table."""
        bounds = np.array(solid.bounding_box())
        return bool(
            np.all(bounds[:2] >= self.lower) and np.all(bounds[3:5] <= self.upper)
        )

    def ground(self, point: np.ndarray) -> float:
        """The height of what is below a point: the table's top or the floor."""
        inside = np.all(point[:2] > self.lower) and np.all(point[:2] < self.upper)
        return self.top if inside else 0.0

    def is_clear(self, solid: Manifold, others: Sequence[Manifold] = ()) -> bool:
        """Whether a solid's box keeps off the robot, and off all else that is there."""
        bounds = np.array(solid.bounding_box())
        low, high = bounds[:3] - GAP, bounds[3:] + GAP
        if np.any(np.all((self.sweep > low) & (self.sweep < high), axis=1)):
            return False
        if np.all(low[:2] < 0.12) and np.all(high[:2] > -0.12):
            return False
        boxes = [np.array(other.bounding_box()) for other in (*self.taken, *others)]
        if low[2] < self.top - 2 * GAP:
            boxes.append(np.array([*self.lower, 0.0, *self.upper, self.top]))
        return all(np.any(high < b[:3]) or np.any(low > b[3:]) for b in boxes)


def draw_clutter(
    bench: Bench,
    sweep: Float64[np.ndarray, "T N 3"],
    weights: Float64[np.ndarray, " N"],
    eye: Float64[np.ndarray, "3"],
    rng: Rng,
) -> Solids:
    """Clutter between a camera and the robot's weighted points, frame by frame: the
    first of many draws that hides as much as it should, else the one that comes
    closest."""
    best, least = [], np.inf
    for _ in range(_CLUTTER_TRIES):
        solids, shares = _draw(bench, eye, rng), np.zeros(1)
        if solids:
            shares = are_hidden(to_mesh(solids), sweep, eye) @ weights
        excess = max(
            HIDDEN_SHARE[0] - shares.mean(),
            shares.mean() - HIDDEN_SHARE[1],
            HIDDEN_IN_A_FRAME[0] - shares.min(),
            shares.max() - HIDDEN_IN_A_FRAME[1],
        )
        if excess < least:
            best, least = solids, excess
        if excess <= 0:
            break
    return best


def are_hidden(
    clutter: trimesh.Trimesh,
    points: Float64[np.ndarray, "T N 3"],
    eye: Float64[np.ndarray, "3"],
) -> Bool[np.ndarray, "T N"]:
    """Which points the clutter stands in front of."""
    rays = (points - eye).reshape(-1, 3)
    hits, hidden = Scene(clutter).cast(eye, rays), np.zeros(len(rays), bool)
    hidden[hits.ray] = hits.distances < np.linalg.norm(rays[hits.ray], axis=1)
    return hidden.reshape(points.shape[:2])


def _draw(bench: Bench, eye: np.ndarray, rng: Rng) -> Solids:
    """Two to four pieces, without those that find no room."""
    placed: Solids = []
    for _ in range(int(rng.integers(2, 5))):
        kind = rng.choice(["box", "screen", "fence"], p=[0.65, 0.15, 0.2])
        seen = bench.sweep[int(rng.integers(len(bench.sweep)))]
        where = eye + rng.uniform(0.25, 0.8) * (seen - eye)
        ground = bench.ground(where)
        if kind == "box":
            solids = [_box(where, ground, rng)]
        elif kind == "screen":
            solids = _screen(where, ground, eye, rng)
        else:
            solids = [_fence(where, eye, rng)]
        if all(bench.is_clear(s, placed) and _is_off(s, eye) for s in solids):
            placed += solids
    return placed


def _box(where: np.ndarray, ground: float, rng: Rng) -> Manifold:
    """A box that reaches up to `where`, or a little above."""
    height = max(where[2] - ground + rng.uniform(0.0, 0.15), 0.08)
    size = np.maximum(rng.uniform(0.12, 0.3, 2), 0.25 * height)
    solid = box((0, 0, 0), (*size, height))
    return upright(solid, np.array([*where[:2], ground]), rng.normal(0, 0.15))


def _screen(where: np.ndarray, ground: float, eye: np.ndarray, rng: Rng) -> Solids:
    """An operator's panel on a pole, its face more or less to the camera."""
    size = rng.uniform(0.2, 0.45), 0.03, rng.uniform(0.15, 0.35)
    low = where[2] - size[2] / 2
    yaw = np.arctan2(eye[1] - where[1], eye[0] - where[0]) + np.pi / 2
    place = np.array([*where[:2], max(low, ground + 0.02)])
    panel = upright(box((0, 0, 0), size), place, yaw + rng.uniform(-0.6, 0.6))
    foot = np.array([*where[:2], ground])
    return [panel, rod(foot, place + (0, 0, 0.05), 0.015, segments=12)]


def _fence(where: np.ndarray, eye: np.ndarray, rng: Rng) -> Manifold:
    """A fence across the line of sight, shifted to one side of it."""
    width = rng.uniform(0.7, 1.4)
    sight = np.arctan2(where[1] - eye[1], where[0] - eye[0])
    yaw = sight + np.pi / 2 + rng.uniform(-0.3, 0.3)
    shift = rng.uniform(-0.5, 0.5) * width * np.array([np.cos(yaw), np.sin(yaw)])
    place = np.array([*(where[:2] + shift), 0.0])
    height = max(where[2] + rng.uniform(-0.1, 0.3), 0.6)
    return upright(fence(width, height, rng), place, yaw)


def _is_off(solid: Manifold, eye: np.ndarray) -> bool:
    """Whether the camera has room before the solid."""
    bounds = np.array(solid.bounding_box())
    return bool(np.any(np.maximum(bounds[:3] - eye, eye - bounds[3:]) > ROOM))


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
    fixtures, posed = _fixtures(bench, reach, rng), _aim(bench.sweep, rng, camera)
    eye = np.asarray(posed.position)
    clutter = draw_clutter(bench, sweep, robot.probe_weights, eye, rng)
    target = np.concatenate([bench.sweep, *map(_corners, fixtures)])
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
    eye = center + distance * direction(azimuth, elevation)
    axes, intrinsics = camera_axes(target - eye), np.asarray(camera.intrinsics, float)
    return dataclasses.replace(
        camera, rotation=axes, translation=-axes @ eye, intrinsics=intrinsics
    )


def _corners(solid: Manifold) -> np.ndarray:
    return np.reshape(solid.bounding_box(), (2, 3))
