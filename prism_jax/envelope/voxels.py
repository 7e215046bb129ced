"""A grid over a workspace in which each voxel is in one of five states.

Free is only what measured rays prove (`prism_jax.envelope.carving`). A completion adds
what may be taken, and unseen space stays unseen.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, UInt8

from prism_jax.io.errors import InputError

MEASURED, ROBOT, PREDICTED, UNSEEN, FREE = range(5)
STATES = ("measured", "robot", "predicted", "unseen", "free")
"""States of a voxel, by their numbers. All but the last may hold something."""

VOXEL = 0.04  # the side of a voxel, in metres

MAX_VOXELS = 20_000_000  # of a grid; a finer one takes more memory than it is worth


@dataclasses.dataclass(frozen=True)
class Grid:
    """Cubes of one size that fill a box."""

    lower: Float64[np.ndarray, "3"]  # the box's corner with the least coordinates
    voxel: float  # the side of each cube, in the unit of `lower`
    shape: tuple[int, int, int]  # how many there are along x, y and z

    @classmethod
    def over(
        cls,
        lower: Float[np.ndarray, "3"],
        upper: Float[np.ndarray, "3"],
        voxel: float = VOXEL,
    ) -> "Grid":
        """The smallest grid at `lower` that reaches `upper`; one voxel at least.

        A box or a voxel that is none, and more than `MAX_VOXELS`, raise InputError.
        """
        lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        if not (np.isfinite(voxel) and voxel > 0):
            raise InputError("voxel", f"invalid size {voxel}", "give a positive length")
        if not (np.isfinite([lower, upper]).all() and (upper >= lower).all()):
            fault = f"not a box: {lower.tolist()} to {upper.tolist()}"
            raise InputError("workspace", fault, "give a lower and an upper corner")
        # What ends at a voxel's face up to rounding needs no voxel more.
        counts = np.maximum(np.ceil((upper - lower) / voxel - 1e-6), 1)
        if np.prod(counts) > MAX_VOXELS:
            fault = f"{np.prod(counts):,.0f} voxels of size {voxel:g} are too many"
            remedy = f"use a smaller box or larger voxels ({MAX_VOXELS:,} at most)"
            raise InputError("workspace", fault, remedy)
        x, y, z = (int(count) for count in counts)
        return cls(lower, float(voxel), (x, y, z))

    @property
    def upper(self) -> Float64[np.ndarray, "3"]:
        """The opposite corner."""
        return self.lower + self.voxel * np.array(self.shape)

    @property
    def half_diagonal(self) -> float:
        """From a voxel's middle to its corners."""
        return 0.5 * math.sqrt(3.0) * self.voxel

    def centers(self) -> Float64[np.ndarray, "V 3"]:
        """The middles of all voxels, z fastest."""
        return self.middles(np.arange(math.prod(self.shape)))

    def middles(self, index: Int[np.ndarray, " N"]) -> Float64[np.ndarray, "N 3"]:
        """The middles of voxels by their numbers."""
        steps = np.stack(np.unravel_index(index, self.shape), axis=1)
        return self.lower + self.voxel * (steps + 0.5)

    def index_of(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
        """The number of the voxel that holds each point; -1 outside of the grid.

        The grid's own border belongs to it. What is not finite is outside.
        """
        points = np.asarray(points, np.float64)
        inside = ((points >= self.lower) & (points <= self.upper)).all(axis=1)
        steps = np.floor((points[inside] - self.lower) / self.voxel).astype(int)
        steps = np.clip(steps, 0, np.array(self.shape) - 1)
        index = np.full(len(points), -1)
        index[inside] = np.ravel_multi_index(tuple(steps.T), self.shape)
        return index


def label(
    grid: Grid,
    free: Bool[np.ndarray, "X Y Z"],
    measured: Float[np.ndarray, "N 3"],
    predicted: Float[np.ndarray, "P 3"],
    robot: Float[np.ndarray, "R 3"],
) -> UInt8[np.ndarray, "X Y Z"]:
    """The state of each voxel: what was measured in it, before what is known of the
    robot, before what is predicted, before whether it was seen.

    A predicted point takes a voxel from free space, and gives none back. Points outside
    of the grid have no voxel.
    """
    state = np.where(free, FREE, UNSEEN).astype(np.uint8)
    for points, name in ((predicted, PREDICTED), (robot, ROBOT), (measured, MEASURED)):
        index = grid.index_of(points)
        state.ravel()[index[index >= 0]] = name
    return state
