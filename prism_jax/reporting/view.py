"""Where a report looks from, and at what."""

import itertools

import numpy as np
from jaxtyping import Float

from prism_jax.geometry.camera import Camera
from prism_jax.geometry.workspace import Workspace

BULK = (0.005, 0.995)
"""Quantiles of the added points, along each axis, that the axes reach to."""


def viewing_direction(
    camera: Camera,
    up: Float[np.ndarray, "3"] | None = None,
    turn_degrees: float = 35.0,
    rise_degrees: float = 20.0,
) -> Float[np.ndarray, "3"]:
    """Toward the viewer: as the camera saw it, but turned, and raised above level. A
    unit vector in the points' frame, as `up` is, z if it is not given. Looking from
    where the sensor stood would hide depth; from elsewhere, what it saw."""
    up = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, np.float64)
    toward = -np.asarray(camera.rotation, np.float64)[2]
    level = toward - (toward @ up) * up
    if np.linalg.norm(level) < 0.1:
        sideways = np.eye(3)[np.argmin(np.abs(up))]
        level = sideways - (sideways @ up) * up
    level = level / np.linalg.norm(level)
    turn, rise = np.deg2rad(turn_degrees), np.deg2rad(rise_degrees)
    level = np.cos(turn) * level + np.sin(turn) * np.cross(up, level)
    return np.cos(rise) * level + np.sin(rise) * up


def shown_bounds(
    measured: Float[np.ndarray, "N 3"],
    added: Float[np.ndarray, "M 3"],
    workspace: Workspace,
) -> Float[np.ndarray, "2 3"]:
    """The box around an object: all that was measured, and the bulk of what was added.
    Added points reach no farther than the workspace, and strays among them do not
    count, so that they cannot make the object small."""
    lower, upper = measured.min(axis=0), measured.max(axis=0)
    if len(added):
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        cube = np.asarray(workspace.from_unit(corners))
        low, high = np.quantile(added, BULK, axis=0)
        lower = np.minimum(lower, np.maximum(low, cube.min(axis=0)))
        upper = np.maximum(upper, np.minimum(high, cube.max(axis=0)))
    return np.stack([lower, upper]).astype(np.float64)
