"""An envelope as a closed surface: the faces of its voxels."""

import struct

import numpy as np
from jaxtyping import Bool, Float, Float64

from prism_jax.envelope.distance import Envelope

FARTHEST = 32_768
"""Steps of a voxel from the origin. OctoMap goes no farther, and STL's single precision
is no coarser than 1/256 of a voxel up to there."""


def envelope_mesh(envelope: Envelope) -> Float64[np.ndarray, "F 3 3"]:
    """The closed surface of the envelope's voxels, in its frame; empty without any.

    Corners of triangles, counter-clockwise from outside; two triangles share each edge.
    It holds the voxels and those that `without_contacts` adds, and nothing else.
    """
    grid = envelope.grid
    inside = without_contacts(envelope.taken).astype(np.int8)
    squares = []
    for axis in range(3):
        right, up = np.eye(3, dtype=int)[[axis - 2, axis - 1]]
        # Counter-clockwise as seen from where the axis points to.
        ring = np.stack([0 * right, right, right + up, up])
        steps = np.diff(inside, axis=axis, prepend=0, append=0)
        squares.append(np.argwhere(steps < 0)[:, None] + ring)
        squares.append(np.argwhere(steps > 0)[:, None] + ring[::-1])
    corners = np.concatenate(squares)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)
    return grid.lower + grid.voxel * corners


def without_contacts(taken: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Voxels, with others added until no two touch along an edge alone, which four
    faces would share.

    One is added beside each such edge, again and again. None is outside of the box
    around a group of voxels that touch, those added included. How far one is from the
    voxels is tested, not proven: two at most.
    """
    filled, before = taken.copy(), -1
    while (count := np.count_nonzero(filled)) > before:
        before = count
        for axis in range(3):
            layers = np.moveaxis(filled, axis, 0)
            here, beside = layers[:, :-1, :-1], layers[:, :-1, 1:]
            below, across = layers[:, 1:, :-1], layers[:, 1:, 1:]
            beside |= here & across & ~below
            here |= beside & below & ~across
    return filled


def stl_bytes(
    mesh: Float[np.ndarray, "F 3 3"], origin: Float[np.ndarray, "3"], note: str
) -> bytes:
    """A binary STL, relative to `origin`; `note` is told in its header."""
    corners = (mesh - origin).astype("<f4")
    ahead = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(*ahead).astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    kinds = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]
    rows = np.zeros(len(corners), kinds)
    rows["normal"], rows["corners"] = normals, corners
    header = note.encode("ascii", "replace")[:80].ljust(80)
    return header + struct.pack("<I", len(rows)) + rows.tobytes()


def stl_origin(envelope: Envelope) -> Float64[np.ndarray, "3"]:
    """What an STL and an OctoMap are written relative to: the user's own origin, or,
    where that is farther than `FARTHEST`, the grid's corner."""
    grid = envelope.grid
    reach = np.abs(np.stack([grid.lower, grid.upper])).max()
    return np.zeros(3) if reach < FARTHEST * grid.voxel else grid.lower.copy()
