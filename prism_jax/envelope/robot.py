"""A robot that is known: its surface by URDF and joint positions, cut out of a scan."""

import functools
import hashlib
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import KDTree

from prism_jax.io.depth import array_of, check_rotation, is_finite
from prism_jax.io.errors import InputError
from prism_jax.io.files import parsing
from prism_jax.robots.urdf import Linkage

SPACING = 0.02  # metres between points on a robot's surface, about

MAX_POINTS = 2_000_000  # of a link's surface: more are those of a wrong unit

ROBOT_MARGIN = 0.03
"""Metres: measured points this near to the robot's surface are the robot's."""

_REMEDY = "give metres (scale=... in the URDF), or leave out what is no robot"

LAYOUT = 'write {"positions": {JOINT: radians or metres}} and, if it is not the frame'
LAYOUT += '\'s own origin, "base": a 4x4 pose of the robot'


def joints_from_dict(
    content: Mapping[str, Any],
    path: str | os.PathLike = "joints",
    based: bool = False,
) -> tuple[dict[str, float], Float64[np.ndarray, "4 4"]]:
    """Joint positions by name and the base's pose in the scan's frame, from the JSON of
    the recordings; InputError about `path`.

    `positions` are needed; `base` is a 4x4 matrix, which `based` needs too, and the
    identity unless given; all else is left alone.
    """
    positions = content.get("positions")
    if type(positions) is not dict or not all(map(is_finite, positions.values())):
        raise InputError(path, "no joint positions", LAYOUT)
    if based and "base" not in content:
        remedy = 'give --base: a JSON with "base", a 4x4 pose in the frame of the scan'
        raise InputError(path, "the robot's base is not known", remedy)
    with parsing(path, "a 4x4 pose", LAYOUT):
        base = array_of(content, "base", np.eye(4))
        check_rotation(base[:3, :3], 1e-6)
        if not np.allclose(base[3], [0, 0, 0, 1]):
            raise ValueError("the last row is not 0, 0, 0, 1")
    return {name: float(value) for name, value in positions.items()}, base


def robot_surface(
    robot: Linkage,
    positions: Mapping[str, float],
    base: Float[np.ndarray, "4 4"],
    spacing: float = SPACING,
    path: str | os.PathLike = "joints",
) -> Float64[np.ndarray, "R 3"]:
    """Points on a robot's surface in the scan's frame, evenly spaced on each link
    (`on_triangles`), so that another pose of the same robot takes next to no time.

    A joint of the robot without a position raises InputError about `path`; other
    positions are left alone.
    """
    missing = [name for name in robot.joints if name not in positions]
    if missing:
        fault = f"no position for joint {missing[0]!r}"
        remedy = f"give all of {', '.join(robot.joints)}"
        raise InputError(path, fault, remedy)
    given = np.array([positions[name] for name in robot.joints])
    poses = base @ robot.link_poses(given[None])[0]
    links = _link_points(robot, spacing)
    placed = [
        points @ pose[:3, :3].T + pose[:3, 3]
        for points, pose in zip(links, poses, strict=True)
    ]
    return np.concatenate(placed)


def robot_digest(robot: Linkage) -> str:
    """Tells robots apart: by the names of their joints and the shapes of their links.
    Where the file lies plays no part."""
    digest = hashlib.sha256("\n".join(robot.joints + robot.link_names).encode())
    for mesh in robot.meshes:
        digest.update(np.asarray(mesh.vertices, "<f8").tobytes())
        digest.update(np.asarray(mesh.faces, "<i8").tobytes())
    return digest.hexdigest()[:16]


@functools.lru_cache(maxsize=4)
def _link_points(robot: Linkage, spacing: float) -> list[Float64[np.ndarray, "_ 3"]]:
    """Points on each link's surface, in its own frame."""
    links: list[np.ndarray] = []
    for mesh in robot.meshes:
        links.append(on_triangles(mesh.vertices, mesh.faces, spacing, robot.path))
        if sum(map(len, links)) > MAX_POINTS:
            raise InputError(robot.path, f"over {MAX_POINTS:,} points", _REMEDY)
    return links


def on_triangles(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    spacing: float = SPACING,
    path: str | os.PathLike = "the robot",
) -> Float64[np.ndarray, "N 3"]:
    """Points on triangles: none of these is farther than `spacing` from one of them.

    Triangles are halved until no side is longer than half of the spacing; of their
    corners in one cube of 0.4 of it, one is kept. The same triangles give the same
    points. More than `MAX_POINTS` raise InputError about `path`.
    """
    corners = np.asarray(vertices, np.float64)[np.asarray(faces, int)]
    if len(corners) == 0:
        return np.zeros((0, 3))
    found = [corners.reshape(-1, 3)]
    long = np.ptp(found[0], axis=0).max()
    start, end, top = corners.swapaxes(0, 1)
    area = 0.5 * np.linalg.norm(np.cross(end - start, top - start), axis=1).sum()
    # A part has no more area than a triangle of three such sides, and the number of a
    # cube has 63 bits.
    least = max(area / (0.11 * spacing**2), 5 * long / spacing)
    # A point is within side / sqrt(3) of a corner of its part, and that within the
    # cube's diagonal of what is kept: 0.29 and 0.70 of the spacing.
    while len(corners):
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        rows = np.flatnonzero(sides.max(axis=1) > 0.5 * spacing)
        ring = (sides[rows].argmax(axis=1)[:, None] + np.arange(3)) % 3
        start, end, top = corners[rows[:, None], ring].swapaxes(0, 1)
        found.append(middle := 0.5 * (start + end))
        if max(least, sum(map(len, found[1:]))) > MAX_POINTS:
            fault = f"a link of {long:,.4g} m takes over {MAX_POINTS:,} points"
            raise InputError(path, fault, _REMEDY)
        halves = [start, middle, top], [middle, end, top]
        corners = np.concatenate([np.stack(half, axis=1) for half in halves])
    points = np.concatenate(found)
    cubes = np.floor((points - points.min(axis=0)) / (0.4 * spacing)).astype(int)
    number = np.ravel_multi_index(tuple(cubes.T), tuple(cubes.max(axis=0) + 1))
    _, rows = np.unique(number, return_index=True)
    return points[np.sort(rows)]


def of_robot(
    points: Float[np.ndarray, "N 3"],
    surface: Float[np.ndarray, "R 3"],
    margin: float = ROBOT_MARGIN,
) -> Bool[np.ndarray, " N"]:
    """Which points lie within `margin` of a robot's surface: its own, in a scan.

    None of an empty surface. What the robot touches goes with it, for so far.
    """
    if len(surface) == 0 or len(points) == 0:
        return np.zeros(len(points), bool)
    return KDTree(surface).query(points, distance_upper_bound=margin)[0] < margin
