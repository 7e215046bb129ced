"""Where things stand, so that none is in another, and what they stand on."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Float64
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from experiments.simulation.roboarm.furnishings import table, to_mesh
from experiments.simulation.solids import Rng, box
from prism_jax.observation.scene import LEFT_OVER, SUPPORT

SIZES = {"table": (0.06, 0.4), "floor": (0.25, 1.6)}
"""The longest side of a thing, by what it stands on."""

GAPS = (0.05, 0.8)  # between a thing and its neighbour, in its own size

STEP = 0.02  # in a thing's size, by which it moves away until it has room

MARGINS = (0.05, 0.7)
"""Between things and the border of what they stand on, in half their width."""

TABLE_HEIGHTS, MIN_TABLE = (0.6, 0.9), 0.45
FLOOR_REACH = (0.5, 2.5)  # how far a floor reaches beyond what stands on it

WALL_SHARE, FLOOR_BELOW_SHARE = 0.4, 0.5
WALL_HEIGHTS, WALL_REACH, WALL_GAP = (0.4, 2.0), (0.1, 1.5), (0.0, 0.3)
THICKNESS = 0.1


class Part(NamedTuple):
    """A mesh of what is around the things, and what its points are labelled."""

    mesh: trimesh.Trimesh
    label: int


class Room(NamedTuple):
    """What things stand on, and what is around them."""

    support: Literal["table", "floor"]
    # The table's top, the floor and the wall are `SUPPORT`, the legs `LEFT_OVER`.
    parts: tuple[Part, ...]
    has_wall: bool  # at the side of +y


def arranged(
    meshes: Sequence[trimesh.Trimesh], support: str, rng: Rng
) -> list[trimesh.Trimesh]:
    """The meshes scaled to some of `SIZES` and set down on z = 0, one beside another,
    so that their convex hulls are apart seen from above."""
    placed: list[trimesh.Trimesh] = []
    hulls: list[np.ndarray] = []
    for mesh in meshes:
        low, high = np.log(SIZES[support])
        size = float(np.exp(rng.uniform(low, high)))
        corners = _set_down(mesh, size, rng)
        hull = corners[ConvexHull(corners[:, :2]).vertices, :2]
        if placed:
            angle = rng.uniform(0, 2 * np.pi)
            along = np.array([np.cos(angle), np.sin(angle)])
            start = hulls[rng.integers(len(hulls))].mean(axis=0)
            gap, shift = size * float(np.exp(rng.uniform(*np.log(GAPS)))), start
            while any(separation(hull + shift, other) < gap for other in hulls):
                shift = shift + STEP * size * along
            hull, corners = hull + shift, corners + (*shift, 0.0)
        placed.append(trimesh.Trimesh(corners, mesh.faces, process=False))
        hulls.append(hull)
    return placed


def _set_down(mesh: trimesh.Trimesh, size: float, rng: Rng) -> np.ndarray:
    """Corners of the mesh in that size, turned, its middle above the origin."""
    angle = rng.integers(4) * 90.0 + rng.normal(scale=3.0)
    if rng.random() < 0.5:
        angle = rng.uniform(0, 360)
    corners = Rotation.from_euler("z", angle, degrees=True).apply(mesh.vertices)
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    foot = np.append((lower + upper)[:2] / 2, lower[2])
    return (corners - foot) * (size / np.ptp(mesh.vertices, axis=0).max())


def separation(one: Float[np.ndarray, "N 2"], other: Float[np.ndarray, "M 2"]) -> float:
    """How far two convex polygons are apart across a line along a side of either, which
    is no more than their distance; negative if they overlap."""
    widest = -np.inf
    for first, second in (one, other), (other, one):
        sides = np.roll(first, -1, axis=0) - first
        normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # Corners go round anticlockwise, so that normals point outwards.
        apart = (second @ normals.T).min(axis=0) - (first * normals).sum(axis=1)
        widest = max(widest, float(apart.max()))
    return widest


def random_room(
    things: Sequence[trimesh.Trimesh], support: Literal["table", "floor"], rng: Rng
) -> Room:
    """A table or a floor under things, in some cases with a wall behind them."""
    bounds = np.array([thing.bounds[:, :2] for thing in things])
    lower, upper = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    has_wall = bool(rng.random() < WALL_SHARE)
    margins = rng.uniform(*MARGINS, 4) * (upper - lower).max() / 2
    if support == "floor":
        margins[:3] += rng.uniform(*FLOOR_REACH, 3)
        if not has_wall:
            margins[3] += rng.uniform(*FLOOR_REACH)
    lower, upper = lower - margins[:2], upper + margins[2:]
    parts, ground = [], 0.0
    if support == "table":
        short = np.maximum(MIN_TABLE - (upper - lower), 0)
        lower, upper = lower - short / 2, upper + short / 2
        ground = -rng.uniform(*TABLE_HEIGHTS)
        top, *legs = table(lower, upper, -ground)
        parts += [Part(_moved(to_mesh([top]), ground), SUPPORT)]
        parts += [Part(_moved(to_mesh(legs), ground), LEFT_OVER)]
    behind = upper[1] + (rng.uniform(*WALL_GAP) if support == "table" else 0.0)
    if support == "floor" or rng.random() < FLOOR_BELOW_SHARE:
        reach = np.zeros(2) if support == "floor" else rng.uniform(*FLOOR_REACH, 2)
        last = np.array([upper[0] + reach[0], behind if has_wall else upper[1]])
        parts.append(Part(_slab([*(lower - reach), ground], [*last, ground]), SUPPORT))
    if has_wall:
        sides = rng.uniform(*WALL_REACH, 2)
        first = [lower[0] - sides[0], behind, ground]
        last = [upper[0] + sides[1], behind, rng.uniform(*WALL_HEIGHTS)]
        parts.append(Part(_slab(first, last), SUPPORT))
    return Room(support, tuple(parts), has_wall)


def _slab(first: Sequence[float], last: Sequence[float]) -> trimesh.Trimesh:
    """Between two corners of a face that looks up, or along -y; as thick as
    `THICKNESS` behind it."""
    lower, upper = np.array(first, float), np.array(last, float)
    if lower[1] == upper[1]:
        upper[1] += THICKNESS
    else:
        lower[2] -= THICKNESS
    return to_mesh([box((lower + upper) / 2, upper - lower)])


def _moved(mesh: trimesh.Trimesh, height: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        mesh.vertices + (0.0, 0.0, height), mesh.faces, process=False
    )


def turned(mesh: trimesh.Trimesh, turn: Float64[np.ndarray, "3 3"]) -> trimesh.Trimesh:
    """The mesh with its corners turned."""
    return trimesh.Trimesh(mesh.vertices @ turn.T, mesh.faces, process=False)
