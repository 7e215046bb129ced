"""What arms carry: tool changers, tools, workpieces, and hoses from foot to tool.

A tool's frame is that of the flange it is on: metres, z forward.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Float64
from manifold3d import Manifold

from experiments.simulation.roboarm.furnishings import to_mesh
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.solids import axes_along, box, capsule, rod, sweep, tube

Rng = np.random.Generator

TOOLS = ("parallel", "three_fingers", "suction", "torch", "spindle")
TOOL_SIZES = (0.05, 0.32)  # metres that a tool is about long, without what it holds
CHANGER_SHARE, WORKPIECE_SHARE = 0.5, 0.6


class Tool(NamedTuple):
    """A tool on a flange, with what it holds."""

    mesh: trimesh.Trimesh  # in the flange's frame
    size: float  # metres; about its length
    kind: str  # one of `TOOLS`


def random_tool(reach: float, rng: Rng) -> Tool:
    """A tool for an arm of this reach, often on a tool changer, often with a workpiece
    if it can hold one."""
    size = float(np.clip(reach * rng.uniform(0.09, 0.17), *TOOL_SIZES))
    solids, front = [], 0.0
    if rng.random() < CHANGER_SHARE:
        solids, front = _changer(size, rng), 0.3 * size
    kind = str(rng.choice(TOOLS))
    makers = {
        "parallel": _parallel,
        "three_fingers": _three_fingers,
        "suction": _suction,
        "torch": _torch,
        "spindle": _spindle,
    }
    holds = bool(rng.random() < WORKPIECE_SHARE)
    made = makers[kind](size, holds, rng)
    return Tool(
        to_mesh([*solids, *(solid.translate((0, 0, front)) for solid in made)]),
        size,
        kind,
    )


def _changer(size: float, rng: Rng) -> list[Manifold]:
    """The two halves of a tool changer with a gap between, and plugs at the side."""
    radius = size * rng.uniform(0.28, 0.42)
    halves = [
        rod((0, 0, low * size), (0, 0, high * size), radius * share, segments=24)
        for low, high, share in ((0, 0.14, 1), (0.14, 0.17, 0.8), (0.17, 0.3, 1.05))
    ]
    plug = box((radius, 0, 0.15 * size), (0.3 * size, 0.35 * size, 0.28 * size))
    return [*halves, plug.rotate((0, 0, float(rng.uniform(0, 360))))]


def _parallel(size: float, holds: bool, rng: Rng) -> list[Manifold]:
    """A palm and two fingers, which hold something between them."""
    width, palm = size * rng.uniform(0.5, 0.9), size * rng.uniform(0.35, 0.55)
    opening = width * rng.uniform(0.15, 0.4)
    finger = size * np.array([rng.uniform(0.1, 0.2), 0.08, 1.0]) - (0, 0, palm)
    solids = [box((0, 0, palm / 2), (0.5 * width, width, palm), 0.08 * size)]
    for side in (-1, 1):
        at = side * (opening + finger[1] / 2)
        solids.append(box((0, at, palm + finger[2] / 2), finger))
    return [*solids, *_held(holds, 2 * opening, size, rng)]


def _three_fingers(size: float, holds: bool, rng: Rng) -> list[Manifold]:
    palm, opening = 0.4 * size, size * rng.uniform(0.12, 0.3)
    solids = [rod((0, 0, 0), (0, 0, palm), 0.35 * size, segments=24)]
    for turn in (0.0, 2.1, 4.2):
        along = np.array([np.cos(turn), np.sin(turn), 0])
        foot, knee = 0.28 * size * along, (opening + 0.15 * size) * along
        knuckle, tip = knee + (0, 0, 0.7 * size), opening * along + (0, 0, size)
        solids.append(capsule(foot + (0, 0, palm), knuckle, 0.06 * size, segments=10))
        solids.append(capsule(knuckle, tip, 0.05 * size, segments=10))
    return [*solids, *_held(holds, 2 * opening, size, rng)]


def _held(holds: bool, width: float, size: float, rng: Rng) -> list[Manifold]:
    """Something of this width between the fingers' tips."""
    if not holds:
        return []
    tall, length = size * rng.uniform(0.2, 0.9), size * rng.uniform(0.3, 1.4)
    middle = (0, 0, 0.85 * size + 0.35 * tall)
    kind = rng.integers(3)
    if kind == 0:
        solid = box(middle, (length, width, tall), 0.02 * size)
    elif kind == 1:
        start, end = np.array(middle), np.array(middle)
        start[0], end[0] = -length / 2, length / 2
        bore = width * rng.choice([0.0, 0.35])
        solid = tube(start, end, width / 2, bore, segments=20)
    else:
        plate = box(middle, (length, width, tall))
        side = box((length / 2, 0, middle[2]), (0.2 * length, 2.5 * width, 0.8 * tall))
        solid = plate + side
    return [solid]


def _suction(size: float, holds: bool, rng: Rng) -> list[Manifold]:
    """A frame of cups, and a plate or carton that hangs from them."""
    width, depth = size * rng.uniform(0.6, 1.6, 2)
    bar, cup = 0.08 * size, 0.3 * size
    solids = [
        rod((0, 0, 0), (0, 0, 0.4 * size), 0.15 * size, segments=16),
        box((0, 0, 0.4 * size), (width, bar, bar)),
        box((width / 2, 0, 0.4 * size), (bar, depth, bar)),
        box((-width / 2, 0, 0.4 * size), (bar, depth, bar)),
    ]
    for x, y in itertools.product((-1, 1), (-1, 1)):
        top = np.array([x * width / 2, y * (depth / 2 - bar), 0.4 * size])
        solids.append(rod(top, top + (0, 0, cup), 0.04 * size, 0.1 * size, segments=12))
    if holds:
        tall = size * (0.04 if rng.random() < 0.4 else rng.uniform(0.3, 1.2))
        extent = np.array([width, depth]) * rng.uniform(1.05, 1.4, 2)
        solids.append(box((0, 0, 0.4 * size + cup + tall / 2), (*extent, tall)))
    return solids


def _torch(size: float, holds: bool, rng: Rng) -> list[Manifold]:
    """A welding torch with a bent neck."""
    bend = np.array([rng.uniform(0.15, 0.5) * size, 0, 0.75 * size])
    tip = bend + size * np.array([rng.uniform(0.1, 0.45), 0, 0.4])
    return [
        rod((0, 0, 0), (0, 0, 0.3 * size), 0.2 * size, segments=20),
        capsule((0, 0, 0.2 * size), bend, 0.07 * size, segments=12),
        rod(bend, tip, 0.07 * size, 0.05 * size, segments=12),
    ]


def _spindle(size: float, holds: bool, rng: Rng) -> list[Manifold]:
    """A motor, across the flange or along it, with a cutter."""
    radius = size * rng.uniform(0.2, 0.3)
    plate = box((0, 0, 0.06 * size), (0.7 * size, 0.7 * size, 0.12 * size))
    body = rod((0, 0, 0.1 * size), (0, 0, 0.8 * size), radius, segments=24)
    nose = rod((0, 0, 0.8 * size), (0, 0, 0.95 * size), 0.6 * radius, segments=20)
    cutter = rod((0, 0, 0.9 * size), (0, 0, 1.25 * size), 0.2 * radius, segments=12)
    turned = [body, nose, cutter]
    if rng.random() < 0.4:
        middle = (0, 0, 0.12 * size + radius)
        turned = [
            solid.translate((0, 0, -0.45 * size)).rotate((0, 90, 0)).translate(middle)
            for solid in turned
        ]
    return [plate, *turned]


def on_flange(tool: Tool, pose: Float[np.ndarray, "4 4"], axis: str) -> trimesh.Trimesh:
    """A tool in the robot's frame, its z along the flange's x or z."""
    turn = np.eye(3) if axis == "z" else axes_along(np.array([1.0, 0, 0]))
    vertices = np.asarray(tool.mesh.vertices) @ turn.T
    return trimesh.Trimesh(
        vertices @ pose[:3, :3].T + pose[:3, 3], tool.mesh.faces, process=False
    )


HOSE_SIDES, HOSE_STEPS = 8, 12  # of a section, and between two places that hold it


class Anchor(NamedTuple):
    """Where a hose is held: in the frame of a link, with the direction it passes in and
    the one that leads off the link there."""

    link: str
    point: Float64[np.ndarray, "3"]
    along: Float64[np.ndarray, "3"]
    out: Float64[np.ndarray, "3"]


class Hoses(NamedTuple):
    """Hoses along an arm, which are clamped to some of its links."""

    strands: Sequence[Sequence[Anchor]]  # of each hose, from the foot to the tool
    radius: float  # metres
    slack: float  # how far a hose bows out between anchors; 1 is a smooth curve

    def mesh(self, robot: Robot, positions: Float[np.ndarray, " J"]) -> trimesh.Trimesh:
        """The hoses in one pose, in the robot's frame."""
        angle = 2 * np.pi * np.arange(HOSE_SIDES) / HOSE_SIDES
        outline = self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        solids = []
        for anchors in self.strands:
            held = [_in_robot(anchor, robot, positions) for anchor in anchors]
            path = [held[0].point[None]]
            for start, end in itertools.pairwise(held):
                path.append(_curve(start, end, self.slack)[1:])
            solids.append(sweep(np.concatenate(path), outline))
            for _, point, along, _ in held[1:-1]:
                half = 2.5 * self.radius * along
                solids.append(rod(point - half, point + half, 1.5 * self.radius))
        return to_mesh(solids)


def random_hoses(
    robot: Robot, tool_frame: str, tool: Tool, reach: float, rng: Rng
) -> Hoses | None:
    """One to three hoses beside each other from an arm's foot to its tool, clamped to
    the two longest links between; None for an arm of fewer than four links in a row."""
    chain = robot.chain_to(tool_frame)
    if len(chain) < 4:
        return None
    radius = float(np.clip(reach * rng.uniform(0.007, 0.018), 0.004, 0.035))
    middle = (robot.lower + robot.upper) / 2
    frames = [robot.frame_pose(name, middle) for name in (*chain, tool_frame)]
    ends = [
        np.linalg.inv(own) @ after[:, 3] for own, after in itertools.pairwise(frames)
    ]
    lengths = np.array([np.linalg.norm(end[:3]) for end in ends])
    longest, side = np.sort(1 + np.argsort(lengths[1:-1])[-2:]), rng.normal(size=3)
    places = [
        _beside(robot, chain[index], ends[index][:3], side, radius)
        for index in (0, *longest)
    ]
    turn = rng.uniform(0, 2 * np.pi)
    out, forward = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([0, 0, 1.0])
    rim = tool.size * (0.4 * out + 0.12 * forward)
    places.append((Anchor(tool_frame, rim, forward, out), np.cross(forward, out)))
    strands, count = [], int(rng.choice([1, 2, 3], p=[0.5, 0.35, 0.15]))
    for number in range(count):
        shift = 2.2 * radius * (number - (count - 1) / 2)
        strands.append(
            [
                anchor._replace(point=anchor.point + shift * across)
                for anchor, across in places
            ]
        )
    return Hoses(strands, radius, float(rng.uniform(0.7, 1.3)))


def _beside(
    robot: Robot, link: str, end: np.ndarray, side: np.ndarray, radius: float
) -> tuple[Anchor, np.ndarray]:
    """A place on a link's surface, half way to `end`, on a side; and the direction
    across it, along the surface."""
    mesh, length = robot.meshes[robot.link_names.index(link)], np.linalg.norm(end)
    along = end / length if length > 0.02 else np.array([0, 0, 1.0])
    out = side - (side @ along) * along
    out /= np.linalg.norm(out)
    across = np.cross(along, out)
    lower, upper = mesh.bounds
    middle = 0.5 * end if length > 0.02 else (lower + upper) / 2
    seen = np.asarray(mesh.vertices) - middle
    near = np.abs(seen @ along) < max(0.25 * length, 2 * radius)
    near &= np.abs(seen @ across) < 0.35 * np.ptp(seen @ across)
    reach = (seen[near] if near.any() else seen) @ out
    return Anchor(link, middle + (reach.max() + 1.2 * radius) * out, along, out), across


def _in_robot(anchor: Anchor, robot: Robot, positions: np.ndarray) -> Anchor:
    pose = robot.frame_pose(anchor.link, positions)
    point, along, out = (pose[:3, :3] @ np.asarray(vector) for vector in anchor[1:])
    return Anchor(anchor.link, point + pose[:3, 3], along, out)


def _curve(start: Anchor, end: Anchor, slack: float) -> np.ndarray:
    """Cubic from one place to another, along their directions and a little off both."""
    pull = slack * np.linalg.norm(end.point - start.point) / 3
    share = np.linspace(0, 1, HOSE_STEPS)[:, None]
    rest = 1 - share
    return (
        rest**3 * start.point
        + 3 * rest**2 * share * (start.point + pull * (start.along + 0.8 * start.out))
        + 3 * rest * share**2 * (end.point - pull * (end.along - 0.8 * end.out))
        + share**3 * end.point
    )
