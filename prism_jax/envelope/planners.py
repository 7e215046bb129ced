"""An envelope as motion planners take it: an OctoMap, and boxes.

An OctoMap's binary file (Hornung et al. 2013, "OctoMap: an efficient probabilistic 3D
mapping framework based on octrees") is a text header and two bytes for each node with
children, parents first: two bits a child.
"""

import json

import numpy as np
from jaxtyping import Float, Int

from prism_jax.envelope import NOTICE
from prism_jax.envelope.distance import Envelope
from prism_jax.envelope.mesh import FARTHEST
from prism_jax.envelope.voxels import FREE, UNSEEN
from prism_jax.io.errors import InputError

DEPTH = 16  # of an OctoMap's tree: 2 * `FARTHEST` cells along each axis

UNKNOWN, CLEAR, OCCUPIED, INNER = range(4)
"""What two bits say of a child."""


def octomap_bytes(envelope: Envelope, origin: Float[np.ndarray, "3"]) -> bytes:
    """OctoMap's binary file (.bt), relative to `origin`.

    Measured, robot and predicted voxels are occupied, unseen ones unknown. OctoMap's
    cells start at its origin: where one overlaps several voxels, it is occupied if any
    of them is, and free only if all are. A grid that reaches farther than `FARTHEST`
    raises InputError.
    """
    cells, first = _cells(envelope, origin)
    if ((first < -FARTHEST) | (first + cells.shape > FARTHEST)).any():
        fault = f"reaches over {FARTHEST:,} voxels from the origin, OctoMap's limit"
        remedy = "use larger voxels or a smaller workspace"
        raise InputError("the workspace", fault, remedy)
    steps = np.argwhere(cells)
    keys = steps + first + FARTHEST
    # The path from the root: three bits a level, of z, y and x.
    path = np.zeros(len(keys), np.int64)
    for bit in range(3 * DEPTH):
        path |= (keys[:, bit % 3] >> bit // 3 & 1) << bit
    order = np.argsort(path)
    path, kind = path[order], cells[tuple(steps[order].T)]
    starts, words, size = [], [], min(len(path), 1)
    for level in range(1, DEPTH + 1):
        parent, row, count = np.unique(path >> 3, return_index=True, return_counts=True)
        word = np.add.reduceat(kind << 2 * (path & 7), row)
        alike = np.isin(word, [0x5555, 0xAAAA])  # eight clear ones, or occupied ones
        size += count[~alike].sum()
        starts.append(parent[~alike] << 3 * level)
        words.append(word[~alike])
        path, kind = parent, np.where(alike, word & 3, INNER)
    # Stable: a parent comes before its first child.
    order = np.argsort(np.concatenate(starts[::-1]), kind="stable")
    data = np.concatenate(words[::-1])[order].astype("<u2").tobytes()
    header = f"""# Octomap OcTree binary file
# {NOTICE}
# The origin is at {", ".join(map(str, origin.tolist()))}
id OcTree
size {size}
res {envelope.grid.voxel!r}
data
"""
    return header.encode() + data


def boxes_bytes(envelope: Envelope, frame_id: str) -> bytes:
    """JSON of disjoint boxes that are together the envelope's voxels: these joined
    along z, then equal runs along y, and equal plates along x."""
    lower = np.argwhere(envelope.taken)
    boxes = np.stack([lower, lower + 1], axis=1)
    for axis in (2, 1, 0):
        across = np.delete(boxes, axis, axis=2).reshape(-1, 4)
        order = np.lexsort((boxes[:, 0, axis], *across.T))
        boxes, across = boxes[order], across[order]
        parted = np.ones(len(boxes) + 1, bool)
        parted[1:-1] = (across[1:] != across[:-1]).any(axis=1)
        parted[1:-1] |= boxes[1:, 0, axis] != boxes[:-1, 1, axis]
        boxes = np.stack([boxes[parted[:-1], 0], boxes[parted[1:], 1]], axis=1)
    corners = (envelope.grid.lower + envelope.grid.voxel * boxes).tolist()
    content = {
        "notice": NOTICE,
        "frame_id": frame_id,
        "unit": "m",
        "boxes": [{"lower": lower, "upper": upper} for lower, upper in corners],
    }
    return (json.dumps(content, allow_nan=False) + "\n").encode()


def _cells(
    envelope: Envelope, origin: Float[np.ndarray, "3"]
) -> tuple[Int[np.ndarray, "X Y Z"], Int[np.ndarray, "3"]]:
    """What each cell of an OctoMap is, and the first one's steps from the origin."""
    # Of the voxels that a cell overlaps the highest counts.
    ranks = np.array([CLEAR, UNKNOWN, OCCUPIED])
    rank = np.where(envelope.state == FREE, 0, np.where(envelope.state < UNSEEN, 2, 1))
    place = (envelope.grid.lower - origin) / envelope.grid.voxel
    first = np.round(place)
    for axis in np.flatnonzero(np.abs(place - first) > 1e-6):
        first[axis] = np.floor(place[axis])
        layers = np.moveaxis(rank, axis, 0)
        layers = np.pad(layers, [(1, 1), (0, 0), (0, 0)], constant_values=1)
        rank = np.moveaxis(np.maximum(layers[:-1], layers[1:]), 0, axis)
    return ranks[rank], first.astype(int)
