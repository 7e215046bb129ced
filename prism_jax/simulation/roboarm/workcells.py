"""Robot cells of many layouts around a few poses of an arm.

World frame: metres, z up, floor at z = 0; an arm's first place is above the origin. The
clouds are of robot and fixtures: the arm with its tool and hoses, what is on tables and
on the floor within its reach, and the linear axis that it may stand on. Tables,
pedestals, floor and walls are support; fences, boxes and cabinets are clutter; people
are people.
"""

import dataclasses
import functools

import numpy as np
import trimesh
from jaxtyping import Bool, Float64
from manifold3d import Manifold

from prism_jax.geometry.camera import Camera
from prism_jax.simulation.raycast import Scene
from prism_jax.simulation.roboarm.cell import look_at
from prism_jax.simulation.roboarm.clutter import are_hidden
from prism_jax.simulation.roboarm.furnishings import (
    FIXTURES,
    fence,
    fixture,
    table,
    to_mesh,
    together,
    upright,
)
from prism_jax.simulation.roboarm.models import ArmModel
from prism_jax.simulation.roboarm.mounts import Mount, random_mount
from prism_jax.simulation.roboarm.people import random_person
from prism_jax.simulation.roboarm.robots import Robot
from prism_jax.simulation.roboarm.tooling import (
    Hoses,
    Tool,
    on_flange,
    random_hoses,
    random_tool,
)
from prism_jax.simulation.roboarm.trajectories import Clearance
from prism_jax.simulation.sensors import l515_camera
from prism_jax.simulation.solids import box

Rng = np.random.Generator

PARTS = ("robot", "fixture", "support", "room", "clutter", "person")
HOSE_SHARE = 0.55
PERSON_SHARES = (0.45, 0.35, 0.2)
"""How often nobody, one and two stand in a cell."""
HIDDEN = 0.7
"""Of the arm's surface, what clutter and people hide at most from the camera."""
DISTANCES = (0.6, 1.25)
"""From camera to middle, in units of what shows the whole."""
NEAREST, FARTHEST = 0.6, 7.5
ROOM = 7.0
"""Half of the floor's side."""
_SURFACE = 1500
_POSES = 48
_TRIES = 30
_HALF_FIELD = np.radians(27.5)


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
    """A cell and the poses that an arm takes in it.

    Attributes:
      lower, upper: of robot and fixtures in all poses.
      glossy: which links are, then whether tool and hoses are, and fixtures.
    """

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
    lower: Float64[np.ndarray, "3"]
    upper: Float64[np.ndarray, "3"]
    glossy: Bool[np.ndarray, " K"]

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
    """A random cell; ValueError where a draw finds no room.

    `size` is the camera's height and width in pixels.
    """
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
    layout = _Layout(np.concatenate(swept), arm.reach)
    layout.add([*mount.support, *mount.track])
    if mount.top is not None:
        layout.add([_block(*mount.top)])
    tables = _tables(layout, mount, rng)
    tops = [mount.top] if mount.top is not None else tables
    high = float(mount.bases[0, 2]) > 0.6 and len(tables) > 0
    on_floor = mount.top is None and not high
    fixtures = _fixtures(layout, tops, on_floor, rng)
    support = [*mount.support]
    for lower, upper, height in tables:
        support += table(lower, upper, height)
    track = [
        *mount.track,
        *(s.translate(tuple(mount.bases[0])) for s in mount.carriage),
    ]
    bounds = np.array([s.bounding_box() for s in [*fixtures, *track]]).reshape(-1, 2, 3)
    target = np.concatenate([layout.sweep, bounds.reshape(-1, 3)])
    camera = _aim(layout, target, size, rng)
    eye = np.asarray(camera.position)
    clutter, people = _in_the_way(layout, eye, np.stack(swept), rng)
    lower, upper = target.min(axis=0), target.max(axis=0)
    return Workcell(
        arm=arm,
        positions=positions,
        mount=mount,
        tool=tool,
        hoses=hoses,
        fixtures=to_mesh([*fixtures, *mount.track]),
        support=to_mesh(support),
        room=_room(target, eye, rng),
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


def _surface(mesh: trimesh.Trimesh, rng: Rng) -> Float64[np.ndarray, "N 3"]:
    """Points spread over a mesh."""
    triangles = np.asarray(mesh.vertices)[mesh.faces]
    edges = triangles[:, 1:] - triangles[:, :1]
    cumulative = np.cumsum(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1))
    faces = np.searchsorted(cumulative, rng.random(_SURFACE) * cumulative[-1])
    u, v = np.sort(rng.random((2, _SURFACE, 1)), axis=0)
    corners = triangles[np.minimum(faces, len(triangles) - 1)]
    return u * corners[:, 0] + (v - u) * corners[:, 1] + (1 - v) * corners[:, 2]


def _random_pose(arm: Arm, tool: Tool | None, rng: Rng) -> Float64[np.ndarray, " J"]:
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


class _Layout:
    """What stands where in a cell, by bounding boxes."""

    def __init__(self, sweep: Float64[np.ndarray, "N 3"], reach: float):
        self.sweep, self.reach = sweep, reach
        self.gap = 0.03 + 0.02 * reach
        self._boxes: list[np.ndarray] = []

    def add(self, solids: list[Manifold]) -> None:
        self._boxes += [np.array(solid.bounding_box()) for solid in solids]

    def is_clear(self, solids: list[Manifold], gap: float | None = None) -> bool:
        """Whether solids keep off the arm, and off all that was added."""
        gap = self.gap if gap is None else gap
        return all(self._is_clear(np.array(s.bounding_box()), gap) for s in solids)

    def covers(self, point: np.ndarray, gap: float) -> bool:
        """Whether a point is within a gap of the boxes of what was added."""
        return any(
            np.all(point > b[:3] - gap) and np.all(point < b[3:] + gap)
            for b in self._boxes
        )

    def _is_clear(self, bounds: np.ndarray, gap: float) -> bool:
        low, high = bounds[:3] - gap, bounds[3:] + gap
        if np.any(np.all((self.sweep > low) & (self.sweep < high), axis=1)):
            return False
        low, high = bounds[:3] + 1e-3, bounds[3:] - 1e-3
        return all(np.any(high < b[:3]) or np.any(low > b[3:]) for b in self._boxes)


_Top = tuple[np.ndarray, np.ndarray, float]


def _tables(layout: _Layout, mount: Mount, rng: Rng) -> list[_Top]:
    """Up to two tables around the arm, their corners (x, y) and heights."""
    wanted = int(rng.choice([0, 1, 2], p=[0.25, 0.5, 0.25]))
    if mount.kind == "table":
        wanted = 0
    found: list[_Top] = []
    for _ in range(_TRIES):
        if len(found) == wanted:
            break
        half = layout.reach * rng.uniform(0.2, 0.45, 2)
        half = np.clip(half, 0.2, 0.9)
        angle = rng.uniform(0, 2 * np.pi)
        away = layout.reach * rng.uniform(0.3, 0.9) + half.max()
        middle = away * np.array([np.cos(angle), np.sin(angle)])
        height = float(np.clip(mount.bases[0, 2] + rng.uniform(-0.4, 0.4), 0.2, 1.0))
        block = _block(middle - half, middle + half, height)
        if layout.is_clear([block]):
            layout.add([block])
            found.append((middle - half, middle + half, height))
    return found


def _block(lower: np.ndarray, upper: np.ndarray, height: float) -> Manifold:
    """All that a table keeps others from."""
    return box((*(lower + upper) / 2, height / 2), (*(upper - lower), height))


def _fixtures(
    layout: _Layout, tops: list[_Top], on_floor: bool, rng: Rng
) -> list[Manifold]:
    """Up to six fixtures on tables, or some of them on the floor within reach."""
    placed: list[Manifold] = []
    wanted = int(rng.integers(0, 7))
    for _ in range(_TRIES):
        if len(placed) >= wanted:
            break
        kind = FIXTURES[int(rng.integers(len(FIXTURES)))]
        size = np.clip(layout.reach * rng.uniform(0.1, 0.3), 0.06, 0.6)
        solid = fixture(kind, float(size), rng)
        if tops and not (on_floor and rng.random() < 0.15):
            low, high, height = tops[int(rng.integers(len(tops)))]
            place = np.append(rng.uniform(low, high), height)
            solid = upright(solid, place, rng.uniform(0, np.pi))
            bounds = np.array(solid.bounding_box())
            fits = np.all(bounds[:2] >= low) and np.all(bounds[3:5] <= high)
        else:
            angle = rng.uniform(0, 2 * np.pi)
            away = layout.reach * rng.uniform(0.3, 0.9)
            place = away * np.array([np.cos(angle), np.sin(angle), 0])
            solid, fits = upright(solid, place, rng.uniform(0, np.pi)), True
        if fits and layout.is_clear([solid]):
            layout.add([solid])
            placed.append(solid)
    return placed


def _aim(
    layout: _Layout, target: np.ndarray, size: tuple[int, int], rng: Rng
) -> Camera:
    """A depth camera somewhere around, which sees the whole or a part of it."""
    lower, upper = np.quantile(target, (0.01, 0.99), axis=0)
    center, radius = (lower + upper) / 2, np.linalg.norm(upper - lower) / 2
    for _ in range(_TRIES):
        away = rng.uniform(*DISTANCES) * radius / np.sin(_HALF_FIELD)
        away = np.clip(away, NEAREST, FARTHEST)
        azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 0.9)
        across = np.cos(elevation)
        direction = np.array(
            [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)]
        )
        eye = center + away * direction
        seen = center + rng.normal(0, 0.12, 3) * radius
        nearest = np.linalg.norm(layout.sweep - eye, axis=1).min()
        if eye[2] > 0.3 and nearest > 0.4 and not layout.covers(eye, 0.3):
            rotation, _ = look_at(eye, seen)
            return l515_camera(rotation, eye).resized(*size)
    raise ValueError("no place for the camera")


def _in_the_way(
    layout: _Layout, eye: np.ndarray, swept: np.ndarray, rng: Rng
) -> tuple[list[Manifold], list[Manifold]]:
    """Clutter and people around the arm, many of them before it, who together do not
    hide more of it than `HIDDEN` in any frame."""
    clutter: list[Manifold] = []
    people: list[Manifold] = []
    pieces = int(rng.integers(0, 5))
    persons = int(rng.choice(len(PERSON_SHARES), p=PERSON_SHARES))
    for number in range(pieces + persons):
        for _ in range(6):
            is_person = number >= pieces
            where = _place(layout, eye, rng)
            made = _person(where, rng) if is_person else _piece(where, eye, rng)
            if not layout.is_clear(made) or any(_near(s, eye) for s in made):
                continue
            whole = to_mesh([*clutter, *people, *made])
            few = swept[:, ::4]
            if are_hidden(whole, few, eye).mean(axis=1).max() > HIDDEN:
                continue
            layout.add(made)
            (people if is_person else clutter).extend(made)
            break
    return clutter, people


def _place(layout: _Layout, eye: np.ndarray, rng: Rng) -> np.ndarray:
    """Before the arm, or beside it, at the height of a part of it."""
    part = layout.sweep[int(rng.integers(len(layout.sweep)))]
    if rng.random() < 0.65:
        return eye + rng.uniform(0.25, 0.9) * (part - eye)
    angle, away = rng.uniform(0, 2 * np.pi), layout.reach * rng.uniform(0.7, 1.5) + 0.3
    return np.array([away * np.cos(angle), away * np.sin(angle), part[2]])


def _person(where: np.ndarray, rng: Rng) -> list[Manifold]:
    turn = (0.0, 0.0, float(rng.uniform(0, 360)))
    place = (float(where[0]), float(where[1]), 0.0)
    return [solid.rotate(turn).translate(place) for solid in random_person(rng)]


def _piece(where: np.ndarray, eye: np.ndarray, rng: Rng) -> list[Manifold]:
    """A box, a cabinet, a post or a fence on the floor, up to about `where`."""
    ground = np.array([*where[:2], 0.0])
    tall = max(where[2] + rng.uniform(-0.2, 0.2), 0.2)
    kind = rng.choice(["box", "cabinet", "post", "fence"], p=[0.4, 0.2, 0.15, 0.25])
    if kind == "fence":
        toward = np.arctan2(where[1] - eye[1], where[0] - eye[0])
        turn = toward + np.pi / 2 + rng.uniform(-0.3, 0.3)
        solid = fence(rng.uniform(0.7, 2.2), max(tall, 0.7), rng)
        return [upright(solid, ground, turn)]
    if kind == "box":
        size = (*np.maximum(rng.uniform(0.15, 0.5, 2), 0.25 * tall), tall)
    elif kind == "cabinet":
        size = (rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6), rng.uniform(0.7, 1.5))
    else:
        size = (0.06, 0.06, rng.uniform(1.0, 2.2))
    solid = box((0, 0, size[2] / 2), size, 0.005)
    return [upright(solid, ground, rng.uniform(0, np.pi))]


def _near(solid: Manifold, eye: np.ndarray) -> bool:
    bounds = np.array(solid.bounding_box())
    return bool(np.all(np.maximum(bounds[:3] - eye, eye - bounds[3:]) < 0.3))


def _room(target: np.ndarray, eye: np.ndarray, rng: Rng) -> trimesh.Trimesh:
    """The floor, and up to two walls behind all that the camera looks at."""
    corners = ROOM * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    meshes = [trimesh.Trimesh(corners, faces, process=False)]
    center = target.mean(axis=0)
    toward = np.arctan2(eye[1] - center[1], eye[0] - center[0])
    for side in rng.permutation([-1, 1])[: int(rng.integers(0, 3))]:
        bearing = toward + side * rng.uniform(0.1, 0.7)
        normal = np.array([np.cos(bearing), np.sin(bearing), 0.0])
        along = np.array([-normal[1], normal[0], 0.0])
        offset = (target @ normal).min() - rng.uniform(0.1, 2.0)
        middle = offset * normal
        wall = [
            middle + x * ROOM * along + (0, 0, z)
            for x, z in ((-1, 0), (1, 0), (1, 4), (-1, 4))
        ]
        meshes.append(trimesh.Trimesh(wall, faces, process=False))
    return together(meshes)


def scene_of(parts: dict[str, trimesh.Trimesh]) -> tuple[Scene, list[int]]:
    """One scene of parts, and how many faces each has."""
    meshes = list(parts.values())
    return Scene(together(meshes)), [len(mesh.faces) for mesh in meshes]
