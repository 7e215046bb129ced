"""An envelope as a closed surface, by marching tetrahedra on its voxels.

Each cube between eight middles is six tetrahedra around its diagonal, the same in every
cube (Freudenthal 1942), so that neighbours share their faces, and the surface closes
(Doi & Koide 1991, "An efficient method of triangulating equi-valued surfaces by using
tetrahedral cells").
"""

import itertools
import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.ndimage import binary_erosion

from prism_jax.envelope.distance import Envelope
from prism_jax.envelope.voxels import FREE

NEAREST = 0.02
"""In the length of an edge: the surface keeps so far from its ends, so that no two of
its corners fall on each other."""

FINEST = 1 / 64
"""STL keeps single precision: where it would lose more than this part of a voxel,
coordinates are written from the grid's corner."""

_TOUCHING = np.ones((3, 3, 3), bool)
_CORNERS = np.array([*itertools.product((0, 1), repeat=3)])
_PATHS = np.cumsum(
    [
        np.concatenate([np.zeros((1, 3), int), np.eye(3, dtype=int)[[*axes]]])
        for axes in itertools.permutations(range(3))
    ],
    axis=1,
)
"""Six ways from the corner 000 to 111, one axis at a time: corners of tetrahedra."""


class Mesh(NamedTuple):
    """Triangles, their corners counted counter-clockwise from outside."""

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]


def envelope_mesh(envelope: Envelope) -> Mesh:
    """The closed surface around an envelope, in its frame; empty if that is.

    It holds every point that is within the margin of a surface and in a voxel that is
    not free, if that is not outside of the grid. It reaches beyond those by less than
    two diagonals of a voxel, and by less than two voxels beyond the grid.
    """
    grid = envelope.grid
    # Between middles a distance is interpolated too high, by half a diagonal at most,
    # and corners are kept from the ends of edges, which are a diagonal long at most.
    level = envelope.surface_field - (1 + 2 * NEAREST) * grid.half_diagonal
    outside = 0.5 * grid.voxel
    level = np.minimum(level, 1e6 * grid.voxel)
    # Free voxels next to others stay, or these would lose their corners.
    inner = binary_erosion(envelope.state == FREE, _TOUCHING, border_value=1)
    level = np.where(inner, np.maximum(level, outside), level)
    padded = np.pad(np.pad(level, 1, mode="edge"), 1, constant_values=outside)
    return isosurface(padded, grid.lower - 1.5 * grid.voxel, grid.voxel)


def isosurface(
    values: Float[np.ndarray, "X Y Z"], origin: Float[np.ndarray, "3"], step: float
) -> Mesh:
    """The surface where values on a lattice change their sign: negative is inside.

    `origin` is the place of the first value, `step` the lattice's. Values at its border
    are outside, or the surface is open there. Every edge is shared by two triangles.
    """
    inside = values < 0
    cubes = np.zeros(tuple(count - 1 for count in values.shape), int)
    for corner in _CORNERS:
        ends = tuple(slice(c, c + n) for c, n in zip(corner, cubes.shape, strict=True))
        cubes += inside[ends]
    mixed = np.argwhere((cubes > 0) & (cubes < 8))
    strides = np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
    flat_values, flat_inside = values.ravel(), inside.ravel()
    edges: list[np.ndarray] = []
    for path in _PATHS:
        tetrahedra = (mixed @ strides)[:, None] + path @ strides
        # Every second one is a mirror image.
        turned = np.linalg.det((path[1:] - path[0]).astype(float)) < 0
        if turned:
            tetrahedra = tetrahedra[:, [0, 1, 3, 2]]
        edges += _triangles(tetrahedra, flat_inside)
    if not edges or not sum(map(len, edges)):
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    ends = np.concatenate(edges).reshape(-1, 2)  # three edges a triangle
    ends = np.sort(ends, axis=1)
    key = ends[:, 0] * flat_values.size + ends[:, 1]
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)
    ends = ends[first]
    low, high = flat_values[ends[:, 0]], flat_values[ends[:, 1]]
    share = np.clip(low / (low - high), NEAREST, 1 - NEAREST)[:, None]
    places = np.stack(np.unravel_index(ends, values.shape), axis=-1).astype(np.float64)
    placed = places[:, 0] + share * (places[:, 1] - places[:, 0])
    return Mesh(origin + step * placed, faces.reshape(-1, 3))


def stl_bytes(mesh: Mesh, origin: Float[np.ndarray, "3"], note: str) -> bytes:
    """A binary STL, relative to `origin`; `note` is told in its header."""
    corners = (mesh.vertices - origin).astype("<f4")[mesh.faces]
    ahead = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(*ahead).astype(np.float64)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0, lengths, 1.0)
    rows = np.zeros(
        len(corners),
        [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")],
    )
    rows["normal"], rows["corners"] = normals, corners
    header = note.encode("ascii", "replace")[:80].ljust(80)
    return header + struct.pack("<I", len(rows)) + rows.tobytes()


def stl_origin(envelope: Envelope) -> Float64[np.ndarray, "3"]:
    """What an STL is written relative to: the user's own origin, or, where single
    precision is too coarse for the distance from there, the grid's corner."""
    grid = envelope.grid
    reach = np.abs(np.stack([grid.lower, grid.upper])).max()
    fine = np.spacing(np.float32(reach)) < FINEST * grid.voxel
    return np.zeros(3) if fine else grid.lower.copy()


def _triangles(tetrahedra: np.ndarray, inside: np.ndarray) -> list[np.ndarray]:
    """Triangles as three crossed edges, each two lattice points: (N, 3, 2).

    A tetrahedron's corners are so ordered that the last three are counted
    counter-clockwise as seen from outside of the first.
    """
    marks = inside[tetrahedra] @ np.array([1, 2, 4, 8])
    found = []
    for case in range(1, 15):
        mine = tetrahedra[marks == case]
        if len(mine) == 0:
            continue
        for triangle in _CASES[case]:
            found.append(mine[:, np.array(triangle)])
    return found


def _cases() -> dict[int, list[list[tuple[int, int]]]]:
    """For each set of corners inside, triangles of crossed edges."""
    cases = {}
    for case in range(1, 15):
        within = [c for c in range(4) if case >> c & 1]
        beyond = [c for c in range(4) if not case >> c & 1]
        if len(within) == 2:
            (a, b), (c, d) = within, beyond
            ring = [(a, c), (a, d), (b, d), (b, c)]
            triangles = [[ring[0], ring[1], ring[2]], [ring[0], ring[2], ring[3]]]
        elif len(within) == 1:
            triangles = [[(within[0], c) for c in beyond]]
        else:
            triangles = [[(c, beyond[0]) for c in within]]
        cases[case] = [_outward(t, within, beyond) for t in triangles]
    return cases


def _outward(triangle, within, beyond) -> list[tuple[int, int]]:
    """The triangle turned so that its normal points from inside to outside, in a
    tetrahedron of positive volume."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    places = np.array([corners[list(edge)].mean(axis=0) for edge in triangle])
    normal = np.cross(places[1] - places[0], places[2] - places[0])
    out = corners[beyond].mean(axis=0) - corners[within].mean(axis=0)
    return triangle if normal @ out > 0 else [triangle[0], triangle[2], triangle[1]]


_CASES = _cases()
