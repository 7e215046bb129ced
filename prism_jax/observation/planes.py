"""The large planes of a cloud: tables, floors, walls."""

import dataclasses

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import KDTree

from prism_jax.observation.clusters import thin

MAX_PLANES = 6
"""More are not looked for."""

NUM_TRIALS = 1000
"""Planes through three random points, of which the best is taken."""

MAX_JUDGES = 3000
"""So many points, spread evenly, vote for the planes."""

COARSE = 0.01
"""The first tolerance, in longest sides of the cloud."""

COARSEST = 0.03
"""Points that need a tolerance as large are no plane's: a curved surface's."""

MIN_SHARE = 0.08
"""Of all cells, to be a large plane."""


@dataclasses.dataclass(frozen=True)
class Plane:
    """``points @ normal = offset``, and how far off its points lie.

    Attributes:
      normal: a unit vector.
      offset: in the user's unit, as `tolerance` is.
      tolerance: three standard deviations of its points, half their spacing at least.
    """

    normal: Float64[np.ndarray, "3"]
    offset: float
    tolerance: float

    def height(self, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Signed distances, positive on the side that the normal points to."""
        # About a point of the plane: the origin may be far away.
        foot = self.offset * self.normal
        return (points - foot) @ self.normal

    def flipped(self) -> "Plane":
        """The same plane with its normal on the other side."""
        return Plane(-self.normal, -self.offset, self.tolerance)


def find_planes(points: Float[np.ndarray, "N 3"]) -> list[Plane]:
    """Large planes, the largest first, by RANSAC with a fixed seed.

    Each is refined by least squares of the points within a tolerance that follows from
    their own noise; noise over a hundredth of the cloud's longest side hides a plane.
    Unit and origin of the coordinates do not matter, nor how near the sensor a surface
    is: every cell of the thinned cloud counts alike. Which side a normal points to
    means nothing. Fewer than four distinct places have no plane.
    """
    cells, _ = thin(points)
    if len(cells) < 4:
        return []
    center = cells.mean(axis=0)
    cells = cells - center
    side = np.ptp(cells, axis=0).max()
    spacing = np.median(KDTree(cells).query(cells, k=2)[0][:, 1])
    rng = np.random.default_rng(0)
    rest = np.ones(len(cells), bool)
    planes = []
    for _ in range(MAX_PLANES):
        if rest.sum() < max(4, MIN_SHARE * len(cells)):
            break
        plane = _consensus(cells[rest], COARSE * side, rng)
        if plane is None:
            break
        plane = _refined(cells[rest], plane, spacing, COARSEST * side)
        on = rest & (np.abs(plane.height(cells)) <= plane.tolerance)
        if on.sum() < max(4, MIN_SHARE * len(cells)):
            break
        rest &= ~on
        if plane.tolerance < COARSEST * side:
            offset = float(plane.offset + plane.normal @ center)
            planes.append(dataclasses.replace(plane, offset=offset))
    return planes


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
    points: Float64[np.ndarray, "N 3"], plane: Plane, spacing: float, largest: float
) -> Plane:
    """By least squares over its points, of which each round finds the noise anew."""
    for _ in range(10):
        height = plane.height(points)
        near = points[np.abs(height) <= plane.tolerance]
        if len(near) < 3:
            break
        mean = near.mean(axis=0)
        _, axes = np.linalg.eigh((near - mean).T @ (near - mean))
        normal = axes[:, 0]
        off = np.abs((near - mean) @ normal)
        sigma = 1.4826 * np.median(off)
        tolerance = min(largest, max(3.0 * sigma, 0.5 * spacing))
        plane = Plane(normal, float(normal @ mean), float(tolerance))
    return plane
