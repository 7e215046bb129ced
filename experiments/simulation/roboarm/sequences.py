"""Sequences of an arm in a cell, and their frames as camera and survey measure them.

The survey is the ground truth: what an Ouster gathers of robot and fixtures from all
around, while boxes and fences are away. From each station the sensor turns `TURNS`
times and the ranges of a beam are averaged, which leaves an eighth of one turn's noise;
beams on depth edges are not mixed. Every station is outside the surveyed parts'
bounding sphere, so nothing behind a closed shell gets into the cloud.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float64

from experiments.simulation.raycast import Scene, direction
from experiments.simulation.roboarm.cell import Cell, make_cell
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.roboarm.models import ArmModel
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.roboarm.trajectories import random_trajectory
from experiments.simulation.sensors import (
    L515Config,
    OusterConfig,
    l515_camera,
    l515_depth,
    ouster_scan,
)
from prism_jax.data.ordering import farthest_point_order
from prism_jax.data.recordings import DEPTH_SCALE, LABELS, RecordedFrame
from prism_jax.geometry.camera import Camera
from prism_jax.io.clouds import inside
from prism_jax.io.depth import points_from_depth

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

    Rounds of the stations are made until there are enough returns; after `MAX_ROUNDS`
    the order is repeated cyclically. A scene that returns nothing raises ValueError.
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


STEADY = 0.03
"""Metres: a pixel between two surfaces is told by its depth, which differs by more than
this from that of most of its neighbours."""
MIN_PARTIAL = 64
CLOUD_STEP = 2.0**-12
"""Metres to which clouds are rounded: finer than either sensor's step, and files of
such numbers compress to two thirds."""
_L515 = L515Config()


@dataclasses.dataclass(frozen=True)
class RoboArmConfig:
    """Sizes and sensors of the simulated recordings.

    `glossy_share` is the probability that a link, or all fixtures, mirror the beams.
    """

    width: int = 640
    height: int = 480
    complete_points: int = 16384
    num_waypoints: int = 4
    num_stations: int = NUM_STATIONS
    glossy_share: float = 0.15
    depth_sensor: L515Config = _L515
    survey_sensor: OusterConfig = SURVEY


@dataclasses.dataclass(frozen=True)
class Sequence:
    """A robot's way through its cell: joint positions by frame.

    `glossy` says which links are, and last, whether the fixtures are.
    """

    robot: Robot
    cell: Cell
    positions: Float64[np.ndarray, "T J"]
    glossy: Bool[np.ndarray, " K"]


def make_sequence(
    model: ArmModel, num_frames: int, config: RoboArmConfig, rng: np.random.Generator
) -> Sequence:
    """A random trajectory of an arm and a cell around it."""
    robot = Robot(model)
    positions = random_trajectory(robot, num_frames, config.num_waypoints, rng)
    camera = l515_camera(np.eye(3), np.zeros(3)).resized(config.height, config.width)
    camera = jax.tree.map(np.float32, camera)
    cell = make_cell(robot, positions, rng, camera)
    glossy = rng.random(len(robot.meshes) + 1) < config.glossy_share
    return Sequence(robot, cell, positions, glossy)


PARTS = ("robot", "fixture", "support", "floor", "box")


def scene_parts(sequence: Sequence, number: int) -> dict[str, trimesh.Trimesh]:
    """The meshes of a frame in the world frame, by the names of `PARTS`."""
    cell, arm = sequence.cell, sequence.robot.mesh(sequence.positions[number])
    arm.apply_translation((0.0, 0.0, cell.base_height))
    meshes = (arm, cell.fixtures, cell.support, cell.floor, cell.clutter)
    return dict(zip(PARTS, meshes, strict=True))


def make_frame(
    sequence: Sequence, number: int, config: RoboArmConfig, rng: np.random.Generator
) -> RecordedFrame:
    """Frame `number` of a sequence; ValueError where nearly nothing of it is seen.

    The partial cloud is what the depth image holds of robot and fixtures within the
    workspace, row by row, without pixels that lie between two surfaces. `joints` also
    says which share of the robot's pixels the clutter hides, and of a robot that is all
    of its file where its base is.
    """
    robot, cell, glossy = sequence.robot, sequence.cell, sequence.glossy
    positions = sequence.positions[number]
    parts = list(scene_parts(sequence, number).values())
    sizes = [len(part.faces) for part in parts]
    kinds = ("robot", "fixture", "clutter", "clutter", "clutter")
    face_labels = np.repeat(np.array([LABELS[kind] for kind in kinds], np.uint8), sizes)
    shiny = np.zeros(sum(sizes), bool)
    shiny[: sizes[0]] = glossy[robot.faces_link]
    shiny[sizes[0] : sizes[0] + sizes[1]] = glossy[-1]
    whole = Scene(together(parts))
    counts, faces = l515_depth(whole, cell.camera, rng, config.depth_sensor, shiny)
    labels = np.where(faces < 0, np.uint8(LABELS["nothing"]), face_labels[faces])

    open_faces, uncluttered = sum(sizes[:3]), Scene(together(parts[:3]))
    wanted = face_labels[:open_faces] != LABELS["clutter"]
    complete = survey(
        uncluttered,
        wanted,
        config.complete_points,
        rng,
        shiny[:open_faces],
        config.survey_sensor,
        config.num_stations,
    )
    joints: dict[str, Any] = {
        "robot": robot.name,
        "positions": dict(zip(robot.joints, positions.tolist(), strict=True)),
    }
    if robot.whole:
        base = robot.mount.copy()
        base[2, 3] += cell.base_height
        joints["base"] = base.tolist()
    hidden = _hidden_share(whole, uncluttered, cell.camera, sizes[0])
    return RecordedFrame(
        depth=counts,
        camera=cell.camera,
        partial=_partial(counts, labels, cell),
        complete=_rounded(complete),
        labels=labels,
        joints={**joints, "hidden_share": round(hidden, 4)},
    )


def flying_pixels(depth: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels with a return (depth above 0) that agrees with that of fewer than three of
    their eight neighbours to within `STEADY`: the L515's pixels across a depth edge."""
    padded = np.pad(depth, 1)
    height, width = depth.shape
    agreeing = np.zeros(depth.shape, int)
    for down in range(3):
        for right in range(3):
            neighbour = padded[down : down + height, right : right + width]
            agreeing += np.abs(neighbour - depth) < STEADY
    return (depth > 0) & (agreeing < 4)


def _partial(counts: np.ndarray, labels: np.ndarray, cell: Cell) -> np.ndarray:
    wanted = (labels == LABELS["robot"]) | (labels == LABELS["fixture"])
    depth = np.where(wanted, counts * DEPTH_SCALE, 0.0)
    points = points_from_depth(depth, wanted & ~flying_pixels(depth), cell.camera)
    points = points[inside(points, cell.lower, cell.upper)]
    if len(points) < MIN_PARTIAL:
        raise ValueError(f"the camera sees {len(points)} points of the robot")
    return _rounded(points)


def _rounded(points: np.ndarray) -> np.ndarray:
    return (np.round(points / CLOUD_STEP) * CLOUD_STEP).astype(np.float32)


def _hidden_share(
    whole: Scene, uncluttered: Scene, camera: Camera, robot_faces: int
) -> float:
    """Of the robot's pixels without the clutter, those that it hides; 1 without any."""
    exact, rng = _L515.exact(), np.random.default_rng(0)
    seen = []
    for scene in (whole, uncluttered):
        _, faces = l515_depth(scene, camera, rng, exact)
        seen.append(np.count_nonzero((faces >= 0) & (faces < robot_faces)))
    return 1 - seen[0] / max(seen[1], 1)
