"""Robot cells of many layouts around a few poses of an arm.

World frame: metres, z up, floor at z = 0; an arm's first place is above the origin. The
clouds are of robot and fixtures: the arm with its tool and hoses, what is on tables and
on the floor within its reach, and the linear axis that it may stand on.
"""

import dataclasses
import functools

import numpy as np
import trimesh
from jaxtyping import Bool, Float64

from experiments.simulation.raycast import Scene
from experiments.simulation.roboarm.furnishings import table, to_mesh, together
from experiments.simulation.roboarm.layouts import (
    Layout,
    aim_camera,
    block,
    draw_fixtures,
    draw_in_the_way,
    draw_room,
    draw_tables,
)
from experiments.simulation.roboarm.models import ArmModel
from experiments.simulation.roboarm.mounts import Mount, random_mount
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.roboarm.tooling import (
    Hoses,
    Tool,
    on_flange,
    random_hoses,
    random_tool,
)
from experiments.simulation.roboarm.trajectories import Clearance
from experiments.simulation.solids import Rng
from prism_jax.geometry.camera import Camera

PARTS = ("robot", "fixture", "support", "room", "clutter", "person")
"""What a frame's meshes are of."""
HOSE_SHARE = 0.55  # how often an arm has a dress pack
_SURFACE = 1500
_POSES = 48
_TRIES = 30


@dataclasses.dataclass(frozen=True)
class Arm:
    """An arm that is read once and for all: without its tool."""

    robot: Robot
    clearance: Clearance
    reach: float
    model: ArmModel


@functools.lru_cache(maxsize=32)
def arm_of(model: ArmModel) -> Arm:
    """An arm as it stands in the varied cells; reading one takes a second."""
    robot = Robot(dataclasses.replace(model, tool_link=None))
    rng = np.random.default_rng(0)
    drawn = rng.uniform(robot.lower, robot.upper, (_POSES, len(robot.lower)))
    distances = np.linalg.norm(robot.probe_points(drawn), axis=-1)
    return Arm(robot, Clearance(robot), float(np.quantile(distances, 0.99)), model)


@dataclasses.dataclass(frozen=True)
class Workcell:
    """A cell and the poses that an arm takes in it."""

    arm: Arm
    positions: Float64[np.ndarray, "T J"]
    mount: Mount
    tool: Tool | None
    hoses: Hoses | None
    fixtures: trimesh.Trimesh
    support: trimesh.Trimesh
    room: trimesh.Trimesh
    clutter: trimesh.Trimesh
    people: trimesh.Trimesh
    camera: Camera
    lower: Float64[np.ndarray, "3"]  # of robot and fixtures in all poses
    upper: Float64[np.ndarray, "3"]
    glossy: Bool[np.ndarray, " K"]  # links, then tool with hoses, then fixtures

    def parts(self, number: int) -> dict[str, trimesh.Trimesh]:
        """The meshes of a frame in the world frame, by the names of `PARTS`."""
        arm = _posed(self.arm, self.tool, self.hoses, self.positions[number])
        base = self.mount.bases[number]
        arm.apply_translation(base)
        moved = to_mesh([s.translate(tuple(base)) for s in self.mount.carriage])
        fixtures = together([self.fixtures, moved])
        rest = self.support, self.room, self.clutter, self.people
        return dict(zip(PARTS, (arm, fixtures, *rest), strict=True))


def make_workcell(
    model: ArmModel,
    num_frames: int,
    rng: Rng,
    size: tuple[int, int] = (480, 640),
    glossy_share: float = 0.15,
) -> Workcell:
    """A random cell, for a camera of this height and width in pixels; ValueError where
    a draw finds no room."""
    arm = arm_of(model)
    tool = random_tool(arm.reach, rng) if model.tool_link else None
    hoses = None
    if rng.random() < HOSE_SHARE:
        frame = model.tool_link or arm.robot.link_names[-1]
        size_of = tool or Tool(trimesh.Trimesh(), 0.1 * arm.reach, "hand")
        hoses = random_hoses(arm.robot, frame, size_of, arm.reach, rng)
    positions = np.stack([_random_pose(arm, tool, rng) for _ in range(num_frames)])
    foot = np.asarray(arm.robot.meshes[0].vertices)
    pose = arm.robot.link_poses(positions[:1])[0, 0]
    foot = (foot @ pose[:3, :3].T + pose[:3, 3])[:, :2]
    corners = np.stack([foot.min(axis=0), foot.max(axis=0)])
    mount = random_mount(arm.reach, corners, arm.robot.spacer, num_frames, rng)
    swept = [
        _surface(_posed(arm, tool, hoses, pose), rng) + base
        for pose, base in zip(positions, mount.bases, strict=True)
    ]
    layout = Layout(np.concatenate(swept), arm.reach)
    layout.add([*mount.support, *mount.track])
    if mount.top is not None:
        layout.add([block(*mount.top)])
    tables = draw_tables(layout, mount, rng)
    tops = [mount.top] if mount.top is not None else tables
    high = float(mount.bases[0, 2]) > 0.6 and len(tables) > 0
    fixtures = draw_fixtures(layout, tops, mount.top is None and not high, rng)
    support = [*mount.support]
    for lower, upper, height in tables:
        support += table(lower, upper, height)
    track = [
        *mount.track,
        *(s.translate(tuple(mount.bases[0])) for s in mount.carriage),
    ]
    bounds = np.array([s.bounding_box() for s in [*fixtures, *track]]).reshape(-1, 2, 3)
    target = np.concatenate([layout.sweep, bounds.reshape(-1, 3)])
    camera = aim_camera(layout, target, size, rng)
    eye = np.asarray(camera.position)
    clutter, people = draw_in_the_way(layout, eye, np.stack(swept), rng)
    lower, upper = target.min(axis=0), target.max(axis=0)
    return Workcell(
        arm=arm,
        positions=positions,
        mount=mount,
        tool=tool,
        hoses=hoses,
        fixtures=to_mesh([*fixtures, *mount.track]),
        support=to_mesh(support),
        room=draw_room(target, eye, rng),
        clutter=to_mesh(clutter),
        people=to_mesh(people),
        camera=camera,
        lower=lower,
        upper=upper,
        glossy=rng.random(len(arm.robot.meshes) + 2) < glossy_share,
    )


def _posed(
    arm: Arm, tool: Tool | None, hoses: Hoses | None, pose: np.ndarray
) -> trimesh.Trimesh:
    """Arm, tool and hoses in the arm's frame, in this order."""
    meshes = [arm.robot.mesh(pose)]
    if tool is not None:
        flange = arm.robot.frame_pose(str(arm.model.tool_link), pose)
        meshes.append(on_flange(tool, flange, arm.model.tool_axis))
    if hoses is not None:
        meshes.append(hoses.mesh(arm.robot, pose))
    return together(meshes)


def _surface(mesh: trimesh.Trimesh, rng: Rng) -> np.ndarray:
    """Points spread over a mesh."""
    triangles = np.asarray(mesh.vertices)[mesh.faces]
    edges = triangles[:, 1:] - triangles[:, :1]
    cumulative = np.cumsum(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1))
    faces = np.searchsorted(cumulative, rng.random(_SURFACE) * cumulative[-1])
    u, v = np.sort(rng.random((2, _SURFACE, 1)), axis=0)
    corners = triangles[np.minimum(faces, len(triangles) - 1)]
    return u * corners[:, 0] + (v - u) * corners[:, 1] + (1 - v) * corners[:, 2]


def _random_pose(arm: Arm, tool: Tool | None, rng: Rng) -> np.ndarray:
    """A pose in which the arm and its tool keep off the ground and off the arm."""
    robot = arm.robot
    for _ in range(_TRIES):
        drawn = rng.uniform(robot.lower, robot.upper, (8, len(robot.lower)))
        for pose in drawn[arm.clearance.is_free(drawn)]:
            if tool is None or _tool_is_free(arm, tool, pose, rng):
                return pose
    raise ValueError(f"{robot.name} finds no free pose with its tool")


def _tool_is_free(arm: Arm, tool: Tool, pose: np.ndarray, rng: Rng) -> bool:
    flange = arm.robot.frame_pose(str(arm.model.tool_link), pose)
    points = _surface(on_flange(tool, flange, arm.model.tool_axis), rng)[::8]
    if points[:, 2].min() < 0.02:
        return False
    probes = arm.robot.probe_points(pose[None])[0]
    bodies = arm.robot.bodies[arm.robot.probe_links]
    # The last parts are short, and the tool is on them.
    inner = probes[bodies <= max(bodies) - 3]
    gaps = np.linalg.norm(points[:, None] - inner[None], axis=-1)
    return bool(gaps.min() > 0.03 * max(1.0, arm.reach))


def scene_of(parts: dict[str, trimesh.Trimesh]) -> tuple[Scene, list[int]]:
    """One scene of parts, and how many faces each has."""
    meshes = list(parts.values())
    return Scene(together(meshes)), [len(mesh.faces) for mesh in meshes]
