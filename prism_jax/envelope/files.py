"""What is written of an envelope: arrays, points, solids, numbers, a page."""

import io
import json
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.envelope import NOTICE
from prism_jax.envelope.distance import KINDS, Distances, Envelope
from prism_jax.envelope.mesh import envelope_mesh, stl_bytes, stl_origin
from prism_jax.envelope.page import COLORS, envelope_page
from prism_jax.envelope.planners import boxes_bytes, octomap_bytes
from prism_jax.envelope.voxels import FREE, STATES
from prism_jax.geometry.camera import Camera
from prism_jax.io.ply import vertices_bytes

NAMES = (
    "envelope.npz",
    "envelope.ply",
    "envelope.stl",
    "envelope.bt",
    "envelope.boxes.json",
    "envelope.html",
    "envelope.json",
)
"""In the order in which they are written."""


def envelope_files(
    envelope: Envelope,
    summary: dict[str, Any],
    camera: Camera | None,
    up: Float[np.ndarray, "3"],
    query: tuple[Float[np.ndarray, "N 3"], Distances] | None = None,
) -> dict[str, bytes]:
    """The files by their names. ``summary`` is what envelope.json says, but for where
    the STL is, which is added to it."""
    mesh = envelope_mesh(envelope)
    origin = stl_origin(envelope)
    summary["stl"] = {"triangles": len(mesh), "origin": origin.tolist()}
    page = envelope_page(envelope, summary, camera, up)
    text = json.dumps(summary, indent=2, allow_nan=False)
    contents = (
        npz_bytes(envelope, query),
        ply_bytes(envelope),
        stl_bytes(mesh, origin, "prism_jax envelope. Not safety-rated. No people."),
        octomap_bytes(envelope, origin),
        boxes_bytes(envelope, summary.get("frame_id", "")),
        # A file's name may hold bytes that are no UTF-8.
        page.encode(errors="backslashreplace"),
        (text + "\n").encode(),
    )
    return dict(zip(NAMES, contents, strict=True))


def npz_bytes(
    envelope: Envelope,
    query: tuple[Float[np.ndarray, "N 3"], Distances] | None = None,
) -> bytes:
    """Arrays without any pickles.

    `state` of every voxel with `states`, their names in order of the numbers; `lower`,
    the grid's corner, and `voxel`, the side of one; `not_free` and `surface`, both
    distances of every voxel's middle (float32); the `margin`, and the most that a known
    part's is, `part_margin`; points of every kind of surface; and of a query its
    points, their distances, and whose surface is near.
    """
    grid = envelope.grid
    arrays: dict[str, Any] = {
        "notice": np.array(NOTICE),
        "state": envelope.state,
        "states": np.array(STATES),
        "lower": grid.lower,
        "voxel": np.float64(grid.voxel),
        "not_free": envelope.not_free_field.astype(np.float32),
        "surface": envelope.surface_field.astype(np.float32),
        "margin": np.float64(envelope.margin),
        "part_margin": np.float64(envelope.surfaces.part_margin),
        "envelope": envelope.taken,
        **envelope.surfaces.points,
    }
    if query is not None:
        points, asked = query
        arrays |= {
            "query": points,
            "query_not_free": asked.not_free,
            "query_surface": asked.surface,
            "query_kind": asked.kind,
        }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def ply_bytes(envelope: Envelope) -> bytes:
    """The middles of all voxels that are not free, with their `state`, whether they are
    within the `envelope`, and colours."""
    index = np.nonzero(envelope.state.ravel() != FREE)[0]
    state = envelope.state.ravel()[index]
    palette = np.array([COLORS[name] for name in STATES[:FREE]], np.uint8)
    columns: dict[str, np.ndarray] = {
        "state": state,
        "envelope": envelope.taken.ravel()[index].astype(np.uint8),
    }
    columns |= zip(("red", "green", "blue"), palette[state].T, strict=True)
    names = ", ".join(f"{number}: {name}" for number, name in enumerate(STATES))
    comments = [NOTICE, f"state {names}"]
    return vertices_bytes(envelope.grid.middles(index), columns, comments)


def distances_summary(found: Distances) -> dict[str, Any]:
    """What is told of the points that were asked for: always both distances."""
    if len(found.kind) == 0:
        return {"points": 0, "in_free_space": 0}
    near = int(np.argmin(found.surface))
    kind = int(found.kind[near])
    least = float(found.surface[near])
    return {
        "points": len(found.kind),
        "in_free_space": int((found.not_free > 0).sum()),
        "nearest_not_known_to_be_free": float(found.not_free.min()),
        "nearest_inflated_surface": least if np.isfinite(least) else None,
        "whose_surface": KINDS[kind] if kind >= 0 else None,
    }
