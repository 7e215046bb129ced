"""The large planes of a cloud: tables, floors, walls."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial import ConvexHull, QhullError

from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.preprocessing.segmentation.clusters import components, extent, thin

MAX_PLANES = 6  # more are not looked for
NUM_TRIALS = 1000  # planes through three random points, of which the best is taken
MAX_JUDGES = 3000  # so many points, spread evenly, vote for the planes
TILES = 20  # along a plane: two of them without a point are a gap between two pieces
COARSE = 0.01  # the first tolerance, in longest sides of the cloud
COARSEST = 0.03  # points that need as large a tolerance are of a curved surface
MIN_SHARE = 0.08  # of all cells, to be a large plane
_BLOCK = 16_384  # points at once, which the processor's cache holds


@dataclasses.dataclass(frozen=True, eq=False)
class Plane:
    """``points @ normal = offset``, and how far off its points lie."""

    normal: Float64[np.ndarray, "3"]  # A unit vector
    offset: float  # in the user's unit, as `tolerance` is
    # Three standard deviations of its points, half their spacing at least.
    tolerance: float

    def height(self, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Signed distances, positive on the side that the normal points to."""
        # About a point of the plane: the origin may be far away.
        foot = self.offset * self.normal
        return (points - foot) @ self.normal

    def holds(self, points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        """Which points lie on it, within the tolerance."""
        return np.abs(self.height(points)) <= self.tolerance


class Thinned:
    """A cloud thinned to one point a cell, with its planes, which are found once."""

    def __init__(self, points: Float[np.ndarray, "N 3"]):
        self.points = np.asarray(points, np.float64)
        self.cells = IndexedCloud(thin(self.points)[0])

    @functools.cached_property
    def planes(self) -> list[Plane]:
        """Large planes, the largest first, by RANSAC with a fixed seed.

        Each is refined by least squares of the points within a tolerance that follows
        from their own noise; noise over a hundredth of the cloud's longest side hides a
        plane. Unit and origin do not matter, nor the distance of a surface from the
        sensor. Which side a normal points to means nothing.
        """
        if len(self.cells) < 4:
            return []
        center = self.cells.points.mean(axis=0)
        cells = self.cells.points - center
        side, apart = extent(cells), self.cells.spacing
        rng = np.random.default_rng(0)
        rest = np.ones(len(cells), bool)
        planes = []
        for _ in range(MAX_PLANES):
            if rest.sum() < max(4, MIN_SHARE * len(cells)):
                break
            plane = _consensus(cells[rest], COARSE * side, rng)
            if plane is None:
                break
            plane = _refined(cells[rest], plane, apart, COARSEST * side)
            on = rest & plane.holds(cells)
            if on.sum() < max(4, MIN_SHARE * len(cells)):
                break
            rest &= ~on
            if plane.tolerance < COARSEST * side:
                offset = float(plane.offset + plane.normal @ center)
                planes.append(dataclasses.replace(plane, offset=offset))
        return planes

    @functools.cached_property
    def borders(self) -> "list[Outline | None]":
        """Where each plane has points."""
        return [outline(self.cells.points, plane) for plane in self.planes]


@dataclasses.dataclass(frozen=True)
class Outline:
    """The convex hull of a plane's points, seen along its normal."""

    axes: Float64[np.ndarray, "2 3"]  # two directions in the plane
    # Of unit length and outwards, one for each side of the hull.
    lines: Float64[np.ndarray, "E 2"]
    offsets: Float64[np.ndarray, " E"]  # how far out these sides are
    width: float  # the least distance between two parallel lines around it
    length: float  # the longest side of its box along `axes`
    filled: float  # the share of the area that has points
    count: int  # how many points it is made of

    def depth(self, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """How far inside the hull points project; negative outside."""
        outside = np.full(len(points), -np.inf)
        flat = points @ self.axes.T
        for start in range(0, len(points), _BLOCK):
            some = slice(start, start + _BLOCK)
            for line, offset in zip(self.lines, self.offsets, strict=True):
                beyond = flat[some] @ line - offset
                np.maximum(outside[some], beyond, out=outside[some])
        return -outside


def outline(cells: Float64[np.ndarray, "N 3"], plane: Plane) -> Outline | None:
    """Where a plane has points; None if they span no area. Small parts apart from the
    others, such as where it meets other things, do not count."""
    axes = np.linalg.svd(plane.normal[None])[2][1:]
    flat = cells[plane.holds(cells)] @ axes.T
    middle = flat.mean(axis=0) if len(flat) else np.zeros(2)
    flat = _largest_pieces(flat - middle)
    try:
        hull = ConvexHull(flat)
    except (QhullError, ValueError):
        return None
    lines = hull.equations[:, :2]
    width = np.ptp(flat @ lines.T, axis=0).min()
    tile = 0.05 * width
    filled = len(np.unique(np.floor(flat / tile), axis=0)) * tile**2 / hull.volume
    return Outline(
        axes,
        lines,
        offsets=lines @ middle - hull.equations[:, 2],
        width=float(width),
        length=float(np.ptp(flat, axis=0).max()),
        filled=float(filled),
        count=len(flat),
    )


def _largest_pieces(flat: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "M 2"]:
    """Those of at least a fifth of the largest one's points."""
    tiles, owner = thin(np.pad(flat, [(0, 0), (0, 1)]), TILES)
    reach = 2.0 * extent(flat) / TILES
    piece = components(tiles, np.full(len(tiles), reach))[owner]
    size = np.bincount(piece)
    return flat[(size >= 0.2 * size.max(initial=0))[piece]]


def _consensus(
    points: Float64[np.ndarray, "N 3"], tolerance: float, rng: np.random.Generator
) -> Plane | None:
    """The plane through three of the points that most others are near to."""
    every = -(-len(points) // MAX_JUDGES)
    judges = points[rng.permutation(len(points))[::every]]
    corners = points[rng.integers(len(points), size=(NUM_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    proper = length > 0
    if not proper.any():
        return None
    normals = normals[proper] / length[proper, None]
    offsets = (normals * corners[proper, 0]).sum(axis=1)
    near = np.abs(judges @ normals.T - offsets) <= tolerance
    best = near.sum(axis=0).argmax()
    return Plane(normals[best], float(offsets[best]), tolerance)


def _refined(
    points: Float64[np.ndarray, "N 3"], plane: Plane, apart: float, largest: float
) -> Plane:
    """By least squares over its points, of which each round finds the noise anew."""
    for _ in range(10):
        near = points[plane.holds(points)]
        if len(near) < 3:
            break
        mean = near.mean(axis=0)
        _, axes = np.linalg.eigh((near - mean).T @ (near - mean))
        normal = axes[:, 0]
        off = np.abs((near - mean) @ normal)
        sigma = 1.4826 * np.median(off)
        tolerance = min(largest, max(3.0 * sigma, 0.5 * apart))
        plane = Plane(normal, float(normal @ mean), float(tolerance))
    return plane
