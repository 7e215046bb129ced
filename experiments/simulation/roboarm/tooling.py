"""What arms carry: tool changers, grippers and other tools, and workpieces.

A tool's frame is that of the flange it is on: metres, z forward.
"""

import itertools
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from manifold3d import Manifold

from experiments.simulation.roboarm.furnishings import to_mesh
from experiments.simulation.solids import axes_along, box, capsule, rod, tube

Rng = np.random.Generator

TOOLS = ("parallel", "three_fingers", "suction", "torch", "spindle")
TOOL_SIZES = (0.05, 0.32)
"""Metres that a tool is about long, without what it holds."""
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
