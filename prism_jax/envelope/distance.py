"""How far points are from what may be taken, by two measures that are always told
together: from voxels that are not known to be free, and from surfaces with a margin."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int8, UInt8
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

from prism_jax.envelope.voxels import FREE, STATES, Grid
from prism_jax.io.errors import InputError

KINDS = (*STATES[:3], "part")
"""Whose surfaces: measured, the robot's, predicted, and a known part's."""

NUM_BOXES = 16
"""Nearest middles of voxels among which the nearest box is looked for first."""

LEAF = 10  # points of a leaf of a search tree

_TOUCHING = np.ones((3, 3, 3), bool)


class Distances(NamedTuple):
    """Of each point, in the unit of the grid."""

    # To the nearest voxel that is not known to be free; 0 in one, and outside of the
    # grid, where nothing is known.
    not_free: Float64[np.ndarray, " N"]
    # To the nearest surface inflated by its margin; negative inside. Infinite where
    # there is no surface.
    surface: Float64[np.ndarray, " N"]
    # The number of whose surface that is, in `KINDS`; -1 for none.
    kind: Int8[np.ndarray, " N"]


class Surfaces:
    """Points on surfaces of each kind."""

    def __init__(
        self,
        points: Mapping[str, Float[np.ndarray, "_ 3"]],
        part_margin: float = np.inf,
    ):
        """`points` by their kind, of `KINDS`; a kind may be left out or empty. The
        margin of a known part's is at most `part_margin`. Other names and points that
        are not finite raise InputError."""
        self.points = {kind: np.zeros((0, 3)) for kind in KINDS}
        for kind, cloud in points.items():
            if kind not in KINDS:
                raise InputError(kind, "unknown kind of surface", f"use {KINDS}")
            cloud = np.asarray(cloud, np.float64).reshape(-1, 3)
            if not np.isfinite(cloud).all():
                fault = "some points are not finite"
                raise InputError(f"{kind} surface", fault, "remove them")
            self.points[kind] = cloud
        *others, part = (self.points[kind] for kind in KINDS)
        counts = [*map(len, others)]
        self._kinds = np.repeat(np.arange(len(others), dtype=np.int8), counts)
        self._trees = _tree(np.concatenate(others)), _tree(part)
        self.part_margin = part_margin

    def distance(
        self, points: Float[np.ndarray, "N 3"], margin: float = 0.0
    ) -> tuple[Float64[np.ndarray, " N"], Int8[np.ndarray, " N"]]:
        """The distance to the nearest surface less a margin, and its kind's number.

        Infinite and -1 where there is no surface.
        """
        (away, row), (to_part, _) = (_nearest(tree, points) for tree in self._trees)
        kind = np.append(self._kinds, np.int8(-1))[row]
        away, to_part = away - margin, to_part - min(margin, self.part_margin)
        kind = np.where(to_part < away, np.int8(KINDS.index("part")), kind)
        return np.minimum(away, to_part), kind

    def needed(self, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """The smallest margin at which the inflated surfaces hold each point."""
        away, to_part = (_nearest(tree, points)[0] for tree in self._trees)
        return np.minimum(away, np.where(to_part <= self.part_margin, to_part, np.inf))


def _tree(points: np.ndarray) -> KDTree | None:
    # Boxes that are neither shrunk to their points nor balanced are many times quicker
    # for points far away.
    if len(points) == 0:
        return None
    return KDTree(points, LEAF, False, balanced_tree=False)


def _nearest(tree: KDTree | None, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far the nearest point is, and its row; infinite and -1 if there is none."""
    if tree is None:
        return np.full(len(points), np.inf), np.full(len(points), -1)
    away, row = tree.query(points, workers=-1)
    return np.asarray(away), np.asarray(row)


@dataclasses.dataclass(frozen=True)
class Envelope:
    """What may be taken of a workspace."""

    grid: Grid  # the voxels, in the user's frame and unit
    state: UInt8[np.ndarray, "X Y Z"]  # of each, one of `voxels.STATES` by number
    # What the margin inflates.
    surfaces: Surfaces
    # What they are inflated by: the q of a calibration.
    margin: float

    @functools.cached_property
    def _shell(self) -> KDTree:
        """Middles of the voxels that are not free and have a free neighbour, as has
        whatever is nearest to a free one; the grid's outside among them."""
        taken = np.pad(self.state != FREE, 1, constant_values=True)
        shell = taken & binary_dilation(~taken, _TOUCHING)
        steps = np.argwhere(shell) - 1
        return KDTree(self.grid.lower + self.grid.voxel * (steps + 0.5))

    def query(self, points: Float[np.ndarray, "N 3"]) -> Distances:
        """Both distances of points in the grid's frame; of any number of them.

        Points that are not finite raise InputError.
        """
        points = np.asarray(points, np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise InputError("points", "some points are not finite", "remove them")
        surface, kind = self.surfaces.distance(points, self.margin)
        index, not_free = self.grid.index_of(points), np.zeros(len(points))
        free = np.nonzero((index >= 0) & (self.state.ravel()[index] == FREE))[0]
        if len(free):
            not_free[free] = self._from_free(points[free])
        return Distances(not_free, surface, kind)

    def _from_free(self, asked: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """`Distances.not_free` of points in free voxels."""
        shell = self._shell
        neighbors = min(NUM_BOXES, shell.n)
        apart, rows = shell.query(asked, k=[*range(1, neighbors + 1)])  # pyright: ignore
        boxes = self._to_boxes(asked[:, None], shell.data[rows]).min(axis=1)
        # Boxes that were not asked for can be nearer if the last one's middle is not
        # farther away than this.
        enough = boxes + self.grid.half_diagonal
        if neighbors < shell.n:
            for row in np.nonzero(apart[:, -1] < enough)[0]:
                near = shell.query_ball_point(asked[row], enough[row])
                boxes[row] = self._to_boxes(asked[row], shell.data[near]).min()
        return boxes

    def _to_boxes(self, points: np.ndarray, middles: np.ndarray) -> np.ndarray:
        """Distances from voxels by their middles, their last axis."""
        gaps = np.abs(middles - points) - 0.5 * self.grid.voxel
        return np.linalg.norm(np.maximum(gaps, 0.0), axis=-1)

    @functools.cached_property
    def surface_field(self) -> Float64[np.ndarray, "X Y Z"]:
        """`Distances.surface` of every voxel's middle."""
        away, _ = self.surfaces.distance(self.grid.centers(), self.margin)
        return away.reshape(self.grid.shape)

    @functools.cached_property
    def not_free_field(self) -> Float64[np.ndarray, "X Y Z"]:
        """`Distances.not_free` of every voxel's middle; all beyond the border are not
        free.

        Exact, one axis after the other: a box is as far as its nearest faces are along
        each (Felzenszwalb & Huttenlocher 2012, "Distance transforms of sampled
        functions").
        """
        squares = np.pad(np.where(self.state != FREE, 0.0, np.inf), 1)
        # From the border no voxel is farther than this.
        farthest = min(squares.shape) // 2 + 1
        for axis in range(3):
            before = np.moveaxis(squares, axis, 0)
            least = before.copy()
            for offset in range(1, min(farthest, len(before) - 1) + 1):
                cost = (offset - 0.5) ** 2
                np.minimum(least[offset:], before[:-offset] + cost, out=least[offset:])
                np.minimum(least[:-offset], before[offset:] + cost, out=least[:-offset])
            squares = np.moveaxis(least, 0, axis)
        return self.grid.voxel * np.sqrt(squares[1:-1, 1:-1, 1:-1])

    @functools.cached_property
    def taken(self) -> Bool[np.ndarray, "X Y Z"]:
        """The voxels of the envelope: not known to be free, and reached by a surface's
        margin, if only with a corner."""
        reached = self.surface_field <= self.grid.half_diagonal
        return reached & (self.state != FREE)

    def volumes(self) -> dict[str, float]:
        """Of the voxels in each state, of all that are not free, and of the envelope,
        in cubic units."""
        cube = self.grid.voxel**3
        counts = np.bincount(self.state.ravel(), minlength=len(STATES))
        pairs = zip(STATES, counts, strict=True)
        volumes = {name: float(n * cube) for name, n in pairs}
        volumes["not_free"] = float((counts.sum() - counts[FREE]) * cube)
        volumes["envelope"] = float(self.taken.sum() * cube)
        return volumes
