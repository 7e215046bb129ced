"""Which direction of the user's frame points upwards."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from prism_jax.geometry.camera import Vector
from prism_jax.io.errors import InputError
from prism_jax.io.scan import parse_numbers

AUTO = "auto"  # up is to be found in the points

UP_AXES = ("x", "y", "z", "-x", "-y", "-z")  # the names that `upright` knows

_REMEDY = f"use one of {', '.join(UP_AXES)}, or three numbers such as 0,-0.8,-0.6"


def upright(up: str | Vector) -> Float64[np.ndarray, "3 3"] | None:
    """The rotation that takes up to z, as `Workspace.rotation` has it; None for "z".

    `up` is one of `UP_AXES` or a vector, for which it is the smallest turn. Any other
    name, and a vector that is zero or not finite, raise InputError.
    """
    if isinstance(up, str):
        if up not in UP_AXES:
            raise InputError(f"up={up}", "no such axis", _REMEDY)
        if up == "z":
            return None
        axis = np.eye(3)["xyz".index(up[-1])]
        up = -axis if up[0] == "-" else axis
    up = _unit(up, "up", _REMEDY)
    sine, cosine = np.hypot(up[0], up[1]), up[2]
    ahead = up[:2] / sine if sine > 0 else np.array([0.0, 1.0])
    # Along the horizontal part of up, across it, and z: the turn is about the second.
    axes = np.array([[*ahead, 0.0], [-ahead[1], ahead[0], 0.0], [0.0, 0.0, 1.0]])
    turn = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
    return axes.T @ turn @ axes + 0.0  # without signed zeros


def parse_up(text: str) -> str | Float64[np.ndarray, "3"]:
    """What the flag `--up` says: an axis, "auto", or a unit vector from `x,y,z`.
    Anything else raises InputError."""
    if text in (*UP_AXES, AUTO):
        return text
    remedy = f"{_REMEDY}, or auto"
    return _unit(parse_numbers("--up", text, 3, remedy), "--up", remedy)


def _unit(vector: Any, subject: str, remedy: str) -> Float64[np.ndarray, "3"]:
    """The vector at length one, or InputError."""
    vector = np.asarray(vector, np.float64)
    if vector.shape != (3,):
        raise InputError(subject, f"{vector.tolist()} is not three numbers", remedy)
    if not np.isfinite(vector).all() or not vector.any():
        raise InputError(subject, f"{vector.tolist()} has no direction", remedy)
    # Squares of very large or small numbers would not be representable.
    vector = vector / np.abs(vector).max()
    return vector / np.linalg.norm(vector)
