"""What stands in a robot cell: tables and pedestals, fixtures, boxes, fences, people.

Closed solids in metres, z up, upright at the origin on z = 0 unless said otherwise.
"""

from collections.abc import Sequence

import numpy as np
import trimesh
from manifold3d import Manifold, OpType

from experiments.simulation.solids import Rng, Solids, ball, box, capsule, rod

FIXTURES = ("block", "jig", "posts", "vise", "bin", "step")
_TOP = 0.04


def to_mesh(solids: Sequence[Manifold]) -> trimesh.Trimesh:
    """The solids' triangles, solid by solid; none gives an empty mesh."""
    parts = [solid.to_mesh() for solid in solids]
    return together(
        [
            trimesh.Trimesh(part.vert_properties[:, :3], part.tri_verts, process=False)
            for part in parts
        ]
    )


def together(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """The meshes as one, their triangles in order; none gives an empty mesh."""
    starts = np.cumsum([0, *[len(mesh.vertices) for mesh in meshes]])
    return trimesh.Trimesh(
        np.concatenate([np.empty((0, 3)), *[mesh.vertices for mesh in meshes]]),
        np.concatenate(
            [np.empty((0, 3), int)]
            + [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
        ),
        process=False,
    )


def table(lower: np.ndarray, upper: np.ndarray, height: float) -> Solids:
    """A slab on four legs: `lower` and `upper` are its corners (x, y)."""
    middle, size = (lower + upper) / 2, upper - lower
    slab, inner = box((*middle, height - _TOP / 2), (*size, _TOP)), size / 2 - 0.06
    legs = [
        box(
            (middle[0] + x * inner[0], middle[1] + y * inner[1], (height - _TOP) / 2),
            (0.06, 0.06, height - _TOP),
        )
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return [slab, *legs]


def pedestal(height: float, radius: float) -> Solids:
    """A column between a foot and a flange."""
    foot = box((0, 0, 0.01), (4 * radius, 4 * radius, 0.02))
    flange = rod((0, 0, height - 0.02), (0, 0, height), 1.25 * radius, segments=32)
    return [foot, rod((0, 0, 0.02), (0, 0, height), radius, segments=32), flange]


def fixture(kind: str, size: float, rng: Rng) -> Manifold:
    """One of `FIXTURES`, about `size` wide."""
    width, depth = size * rng.uniform(0.7, 1.0), size * rng.uniform(0.5, 1.0)
    if kind == "block":
        return box((0, 0, 0), (width, depth, size * rng.uniform(0.3, 0.8)), 0.004)
    if kind == "step":
        low = size * rng.uniform(0.2, 0.4)
        tall = box((-width / 4, 0, low), (width / 2, depth, 2 * low))
        return box((0, 0, low / 2), (width, depth, low)) + tall
    if kind == "jig":
        plate = box((0, 0, 0.01), (width, depth, 0.02))
        for x, y in rng.uniform(-0.4, 0.4, (int(rng.integers(4, 8)), 2)):
            foot = np.array([x * width, y * depth, 0.01])
            top = foot + (0, 0, size * rng.uniform(0.15, 0.35))
            plate += rod(foot, top, size * rng.uniform(0.03, 0.06), segments=16)
        return plate
    if kind == "posts":
        tall = size * rng.uniform(0.8, 1.4)
        base = box((0, 0, 0.008), (width, depth / 2, 0.016))
        for side in (-1, 1):
            at = side * 0.38 * width
            base += rod((at, 0, 0.01), (at, 0, tall), 0.06 * size, segments=16)
        return base + box((0, 0, 0.85 * tall), (width, 0.1 * size, 0.1 * size))
    if kind == "vise":
        base = box((0, 0, 0.1 * size), (width, depth / 2, 0.2 * size))
        jaw = (0.15 * size, depth / 2, 0.35 * size)
        opening = width * rng.uniform(0.1, 0.3)
        for side in (-1, 1):
            base += box((side * (opening + jaw[0] / 2), 0, 0.35 * size), jaw)
        return base + rod((0, 0, 0.1 * size), (0.7 * width, 0, 0.1 * size), 0.04 * size)
    tall, wall = size * rng.uniform(0.25, 0.5), 0.03 * size
    hollow = box((0, 0, wall + tall / 2), (width - 2 * wall, depth - 2 * wall, tall))
    return box((0, 0, tall / 2), (width, depth, tall)) - hollow


def fence(width: float, height: float, rng: Rng) -> Manifold:
    """A frame in the x-z plane on two posts, filled with upright bars or panels."""
    post, rail = 0.025, 0.02
    foot = rng.uniform(0.1, 0.25)
    solids = [
        box((side * width / 2, 0, height / 2), (2 * post, 2 * post, height))
        for side in (-1, 1)
    ]
    solids += [box((0, 0, z), (width, rail, 2 * rail)) for z in (foot, height - rail)]
    pitch, radius = rng.uniform(0.06, 0.14), rng.uniform(0.004, 0.01)
    for x in np.arange(-width / 2 + pitch, width / 2, pitch):
        solids.append(rod((x, 0, foot), (x, 0, height - rail), radius, segments=8))
    if rng.random() < 0.5:
        panel = height * rng.uniform(0.2, 0.45)
        solids.append(box((0, 0, foot + panel / 2), (width, 0.008, panel)))
    return Manifold.batch_boolean(solids, OpType.Add)


def upright(solid: Manifold, place: np.ndarray, yaw: float) -> Manifold:
    """The solid, turned by `yaw` radians, standing on the point `place`."""
    low = solid.bounding_box()[2]
    turned = solid.translate((0, 0, -low)).rotate((0, 0, float(np.degrees(yaw))))
    return turned.translate((float(place[0]), float(place[1]), float(place[2])))


HEIGHTS = (1.5, 1.95)


def random_person(rng: np.random.Generator) -> Solids:
    """Legs, trunk, head and arms, each of which hangs or reaches out by itself."""
    height = rng.uniform(*HEIGHTS)
    hip, shoulder = 0.5 * height, 0.8 * height
    lean, breadth = height * rng.uniform(-0.03, 0.12), height * rng.uniform(0.1, 0.13)
    chest = np.array([lean, 0, shoulder])
    solids = [
        capsule((0, 0, hip), chest - (0, 0, 0.03), 0.075 * height, 0.085 * height),
        ball(chest + (0.3 * lean, 0, 0.125 * height), 0.068 * height),
    ]
    stride = height * rng.uniform(-0.12, 0.12)
    for side in (-1, 1):
        foot = (side * stride, side * 0.07 * height, 0.035 * height)
        knee = (side * stride * 0.6 + 0.02, side * 0.065 * height, 0.27 * height)
        solids.append(capsule(foot, knee, 0.035 * height, 0.04 * height, 12))
        top = (0, side * 0.05 * height, hip)
        solids.append(capsule(knee, top, 0.04 * height, 0.055 * height, 12))
        joint = chest + (0, side * (breadth + 0.03 * height), 0)
        raised = rng.choice([rng.uniform(-0.3, 0.3), rng.uniform(0.4, 1.7)])
        bent = raised + rng.uniform(0, 1.3)
        elbow = joint + 0.18 * height * _hanging(raised)
        hand = elbow + 0.2 * height * _hanging(bent)
        solids.append(capsule(joint, elbow, 0.032 * height, 0.028 * height, 12))
        solids.append(capsule(elbow, hand, 0.028 * height, 0.025 * height, 12))
    return solids


def _hanging(angle: float) -> np.ndarray:
    """Downwards, raised to the front by an angle in radians."""
    return np.array([np.sin(angle), 0, -np.cos(angle)])
