"""What a completion is asked, beside the scan itself."""

import dataclasses
from typing import get_args

import numpy as np

from prism_jax.geometry.camera import Vector
from prism_jax.geometry.visibility import Background
from prism_jax.io.errors import InputError, choose
from prism_jax.preprocessing.upright import AUTO, upright


@dataclasses.dataclass(frozen=True)
class CompletionOptions:
    """The keyword arguments of `prism_jax.Completer.complete`.

    Values that make no sense raise `prism_jax.io.InputError`.
    """

    # Whether the network adapts to the scan first. It has no reliable benefit.
    adapt: bool = False
    # The direction in the user's frame that points upwards, for the weights know
    # upright objects: x, y, z, -x, -y or -z (-y for a camera's axes), a vector, or
    # "auto" (`prism_jax.preprocessing.segmentation.support.find_up`).
    up: str | Vector = "z"
    # Added points are so many times as dense as the measured ones where the network's
    # output is a surface, and never sparser than that; 0 leaves them as predicted.
    density: float = 1.0
    # "empty": the sensor would have seen whatever else there is around the points.
    # Nothing is added there, and networks that read visibility are given that.
    background: Background = "unknown"

    def __post_init__(self):
        if self.density < 0 or not np.isfinite(self.density):
            fault = f"invalid value {self.density}"
            raise InputError("density", fault, "give 0 or a positive number, such as 1")
        choose("background", self.background, get_args(Background))
        if not self.finds_up:
            upright(self.up)

    @property
    def finds_up(self) -> bool:
        """Whether up is to be found in the points."""
        return isinstance(self.up, str) and self.up == AUTO
