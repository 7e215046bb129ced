"""What a sensor that stands still saw before, where something hides it now."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from prism_jax.observation.visibility import in_front

STEADY = 3
"""Frames that a voxel is seen in before it is remembered. What moves is gone sooner."""

SURE = 6
"""Frames that count, at most: as many that look through a voxel forget it."""

_OFFSET = 2**20
"""Voxels on either side of the origin, along each axis."""


@dataclasses.dataclass
class Accumulator:
    """Voxels that were measured in earlier frames of a sensor that does not move.

    Each voxel counts the frames that it was measured in, up to `SURE`. A frame that
    looks through it, because all that is measured about its line of sight now lies
    behind it, takes one away, and at none it is forgotten: so what has moved decays.
    One that is hidden, or about which nothing was measured, keeps its count if it was
    seen in `STEADY` frames or more, and is forgotten if not.

    Attributes:
      voxel: its side, in the unit of the points: some spacings of them.
    """

    voxel: float

    def __post_init__(self):
        if not 0 < self.voxel < np.inf:
            raise ValueError(f"a voxel cannot be {self.voxel} wide")
        self._keys: Int[np.ndarray, " V"] = np.zeros(0, np.int64)
        self._points: Float[np.ndarray, "V 3"] = np.zeros((0, 3))
        self._counts: Int[np.ndarray, " V"] = np.zeros(0, np.int64)

    def __len__(self) -> int:
        """Voxels with a count, remembered or not."""
        return len(self._keys)

    def add(
        self,
        points: Float[np.ndarray, "N 3"],
        measured: Float[np.ndarray, "M 3"],
        eye: Float[np.ndarray, "3"],
    ) -> Float[np.ndarray, "K 3"]:
        """Counts a frame, and gives what it lacks: a point measured earlier in each
        voxel that is remembered, farther than a voxel from all of the frame's points.

        ``points`` are what is of interest, within a workspace, and ``measured`` all
        that the sensor at ``eye`` measured in that frame. One frame of reference and
        one unit for all, and finite. NumPy, in double precision.
        """
        points = np.asarray(points, np.float64)
        hit, first = np.unique(self._voxels(points), return_index=True)
        again = np.isin(self._keys, hit, assume_unique=True)
        old = np.flatnonzero(~again)
        through = in_front(
            self._points[old], np.asarray(measured, np.float64), eye, self.voxel, 1.0
        )
        counts = self._counts[old] - through
        kept = (counts > 0) & (through | (counts >= STEADY))
        lacking = self._points[old[~through & (counts >= STEADY)]]

        before = np.zeros(len(hit), np.int64)
        place = np.searchsorted(hit, self._keys[again])
        before[place] = self._counts[again]
        keys = np.concatenate([hit, self._keys[old[kept]]])
        order = np.argsort(keys)
        self._keys = keys[order]
        everything = np.concatenate([points[first], self._points[old[kept]]])
        self._points = everything[order]
        counted = np.concatenate([np.minimum(before + 1, SURE), counts[kept]])
        self._counts = counted[order]
        if len(lacking) == 0 or len(points) == 0:
            return lacking
        return lacking[KDTree(points).query(lacking)[0] > self.voxel]

    def _voxels(self, points: np.ndarray) -> Int[np.ndarray, " N"]:
        """The number of each point's voxel."""
        cells = np.floor(points / self.voxel).astype(np.int64)
        x, y, z = (np.clip(cells, -_OFFSET, _OFFSET - 1) + _OFFSET).T
        return (x << 42) | (y << 21) | z
