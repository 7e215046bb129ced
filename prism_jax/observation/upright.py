"""The axis of the user's frame that points upwards."""

import numpy as np
from jaxtyping import Float64

from prism_jax.io.errors import InputError

_TURNS = {
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "z": None,
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}

UP_AXES = tuple(_TURNS)
"""What `upright` knows."""


def upright(up: str) -> Float64[np.ndarray, "3 3"] | None:
    """The rotation that takes one of `UP_AXES` to z, as `Workspace.rotation` has it.

    None for z itself. Any other name raises InputError.
    """
    if up not in _TURNS:
        raise InputError(f"up={up}", "no such axis", f"use one of {', '.join(UP_AXES)}")
    turn = _TURNS[up]
    return None if turn is None else np.array(turn, np.float64)
