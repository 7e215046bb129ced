"""Dress packs: hoses along an arm, from its foot to its tool."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Float64

from experiments.simulation.roboarm.furnishings import to_mesh
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.roboarm.tooling import Tool
from experiments.simulation.solids import rod, sweep

Rng = np.random.Generator

HOSE_SIDES, HOSE_STEPS = 8, 12
"""Of a hose's section, and between two places that it is held at."""


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
    """One to three hoses beside each other from an arm's foot to its tool.

    They are clamped to the two longest links between, on one side. None for an arm of
    fewer than four links in a row.
    """
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
    longest = np.sort(1 + np.argsort(lengths[1:-1])[-2:])
    side = rng.normal(size=3)
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
    mesh = robot.meshes[robot.link_names.index(link)]
    length = np.linalg.norm(end)
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


def _curve(start: Anchor, end: Anchor, slack: float) -> Float64[np.ndarray, "S 3"]:
    """Cubic from one place to another, along their directions and a little off both."""
    pull = slack * np.linalg.norm(end.point - start.point) / 3
    share = np.linspace(0, 1, HOSE_STEPS)[:, None]
    rest = 1 - share
    leaves = start.point + pull * (start.along + 0.8 * start.out)
    arrives = end.point - pull * (end.along - 0.8 * end.out)
    return (
        rest**3 * start.point
        + 3 * rest**2 * share * leaves
        + 3 * rest * share**2 * arrives
        + share**3 * end.point
    )
