"""A cloud, and what several steps ask of it, in NumPy and double precision."""

import functools
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Float64, Int
from scipy.spatial import KDTree

NUM_NEAR = 8  # neighbours that a density is taken from

ENOUGH = 2**18  # points of a scan: more say no more of an object, and take longer

MAX_SIGHTS = 16_384  # lines of sight to a larger cloud lead to evenly spaced rows


def cell_codes(index: Int[np.ndarray, "N D"]) -> Int[np.ndarray, " N"]:
    """A number for the cell of each row, in the order of the cells' indices."""
    index = index - index.min(axis=0)
    shape = index.max(axis=0) + 1
    if np.prod(shape, dtype=float) < 2**62:
        return np.asarray(np.ravel_multi_index(tuple(index.T), tuple(shape)))
    return np.unique(index, axis=0, return_inverse=True)[1].ravel()


def sphere(count: int) -> Float64[np.ndarray, "count 3"]:
    """Unit vectors spread over the sphere: a Fibonacci lattice."""
    index = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * index / count, np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


class IndexedCloud:
    """Points whose tree, spacing and density are computed once, when first needed."""

    def __init__(self, points: Float[Array | np.ndarray, "N 3"], share: float = 1.0):
        self.points = np.asarray(points, np.float64)
        self.share = share  # of the points that there are
        self._sights: dict[bytes, tuple[KDTree, Float[np.ndarray, " N"]]] = {}

    @classmethod
    def of(cls, points: Any) -> "IndexedCloud":
        """A cloud as it is, or one of an array of points."""
        return points if isinstance(points, IndexedCloud) else cls(points)

    @classmethod
    def of_enough(
        cls, points: Float[np.ndarray, "N 3"], most: int = ENOUGH
    ) -> "IndexedCloud":
        """Of so many points at most, drawn at random, the same ones each time."""
        count = len(points)
        if count <= most:
            return cls(points)
        drawn = np.random.default_rng(0).choice(count, most, False, shuffle=False)
        return cls(points[np.sort(drawn)], most / count)

    def __len__(self) -> int:
        return len(self.points)

    @functools.cached_property
    def tree(self) -> KDTree:
        """Of all points, in their order."""
        return KDTree(self.points)

    @functools.cached_property
    def distinct(self) -> "IndexedCloud":
        """The points without copies, sorted. The rows of its tree are in any order."""
        distinct = IndexedCloud(np.unique(self.points, axis=0))
        if len(distinct) == len(self):
            distinct.tree = self.tree
            if len(self) <= MAX_SIGHTS:  # the same lines of sight, in another order
                distinct._sights = self._sights
        return distinct

    @functools.cached_property
    def spacing(self) -> float:
        """Median distance of a distinct point to its nearest other; infinite for one.

        In the points' unit.
        """
        own = self.distinct
        if len(own) < 2:
            return np.inf
        return float(np.median(own.distance(own.points, 2)))

    @functools.cached_property
    def density(self) -> float:
        """Points a square unit, where the cloud is as dense as usual, of all there are.

        By the eighth neighbour: the nearest ones of a LiDAR's points all lie on one
        line. Zero for a cloud of fewer than nine distinct points.
        """
        own = self.distinct
        if len(own) <= NUM_NEAR:
            return 0.0
        apart = own.distance(own.points, NUM_NEAR + 1)
        return float(NUM_NEAR / (np.pi * np.median(apart) ** 2) / self.share)

    def distance(
        self, points: Float[np.ndarray, "Q 3"], k: int = 1
    ) -> Float[np.ndarray, " Q"]:
        """From each of some points to the k-th nearest of the cloud, or to the farthest
        if it has fewer. The cloud must not be empty."""
        nearest: Any = [min(k, len(self))]
        return np.asarray(self.tree.query(points, k=nearest)[0])[:, 0]

    def sights(
        self, eye: Float[np.ndarray, "3"]
    ) -> tuple[KDTree, Float[np.ndarray, " N"]]:
        """Lines of sight to the points from a sensor at `eye`: a tree of their
        directions, and the distance along each. The cloud is not empty."""
        eye = np.asarray(eye, np.float64)
        key = eye.tobytes()
        if key not in self._sights:
            every = -(-len(self) // MAX_SIGHTS)
            directions, distance = sight(self.points[::every], eye)
            self._sights[key] = KDTree(directions), distance
        return self._sights[key]


def sight(
    points: Float[np.ndarray, "N 3"], eye: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Directions from the eye to points, and distances along them."""
    rays = points - eye
    distance = np.maximum(np.linalg.norm(rays, axis=1), np.finfo(np.float64).tiny)
    return rays / distance[:, None], distance
