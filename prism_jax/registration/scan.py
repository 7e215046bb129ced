"""What is registered of a scan: fewer points, with normals, and the sensor's noise."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.spatial import KDTree

from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.geometry.visibility import Visibility
from prism_jax.preprocessing.segmentation.clusters import thin
from prism_jax.registration.surface import spread, widths_of

CELLS = 40  # of a scan along its longest side, whose means make its normals
COARSE_CELLS = 14  # likewise, for neighbours that a model misses alike
NEIGHBORS = 12
RAW = 2500  # measured points that are compared with a model
SEARCHED = 200  # of the means, that poses are looked for with
NUM_PAIRS = 4000
FLYING = 0.01  # share of points that may fly off at each end
LEAST_NOISE = 0.001  # in the longest side: what nobody's models keep to anyway


@dataclasses.dataclass(frozen=True)
class Scan:
    """Measured points of one object, in the user's frame and unit, from a sensor at
    `eye`."""

    points: Float[np.ndarray, "N 3"]
    eye: Float[np.ndarray, "3"]  # where it stood, perhaps a guess
    visibility: Visibility | None = None  # what it knows, if it is known where it stood

    @functools.cached_property
    def raw(self) -> IndexedCloud:
        """At most `RAW` points as they were measured, drawn at random."""
        return IndexedCloud.of_enough(self.points, RAW)

    @functools.cached_property
    def cells(self) -> Int[np.ndarray, " M"]:
        """Which of the `raw` points are neighbours: those of one number."""
        return thin(self.raw.points, COARSE_CELLS)[1]

    @functools.cached_property
    def means(self) -> Float64[np.ndarray, "M 3"]:
        """The means of the points in cells."""
        return thin(self.points, CELLS)[0]

    @functools.cached_property
    def middle(self) -> Float64[np.ndarray, "3"]:
        """Of the means: poses turn about it."""
        return self.means.mean(axis=0)

    @functools.cached_property
    def normals(self) -> Float64[np.ndarray, "M 3"]:
        """Of the means, towards the sensor."""
        means = self.means
        near = KDTree(means).query(means, k=min(NEIGHBORS, len(means)))[1]
        around = means[near] - means[near].mean(axis=1, keepdims=True)
        normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
        toward = np.einsum("ij,ij->i", normals, self.eye - means) > 0
        return np.where(toward[:, None], normals, -normals)

    @functools.cached_property
    def some(self) -> Int[np.ndarray, " S"]:
        """Rows of the means, evenly spread, for the search of poses; the first of them
        are spread too."""
        return spread(self.means, SEARCHED)

    @functools.cached_property
    def pairs(self) -> Int[np.ndarray, "P 2"]:
        """Pairs of rows of the means, some way apart."""
        rng = np.random.default_rng(0)
        pairs = rng.choice(self.some, (NUM_PAIRS, 2))
        one, other = self.means[pairs].swapaxes(0, 1)
        apart = np.linalg.norm(one - other, axis=1)
        return pairs[apart > 0.3 * self.size]

    @functools.cached_property
    def widths(self) -> Float64[np.ndarray, " D"]:
        """In many directions, without what flies about."""
        return widths_of(self.points, FLYING)

    @property
    def size(self) -> float:
        """The largest of the widths."""
        return float(self.widths[-1])

    @functools.cached_property
    def noise(self) -> float:
        """Standard deviation of the points along their rays: from planes through their
        neighbours, seen from the sensor, so that points of one beam, nearly on a line,
        have it too."""
        cloud = IndexedCloud(np.unique(self.points, axis=0))
        count = min(NEIGHBORS, len(cloud))
        near = cloud.points[np.asarray(cloud.tree.query(self.raw.points, k=count)[1])]
        rays = self.raw.points - self.eye
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        offsets = near - near.mean(axis=1, keepdims=True)
        depth = np.einsum("nki,ni->nk", offsets, rays)
        across = offsets - depth[..., None] * rays[:, None]
        squares = np.einsum("nki,nkj->nij", across, across)
        ridge = 1e-3 * np.trace(squares, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        along = np.einsum("nki,nk->ni", across, depth)
        slope = np.linalg.solve(squares + ridge + 1e-30 * np.eye(3), along[..., None])
        left = depth - (across @ slope)[..., 0]
        variance = np.einsum("nk,nk->n", left, left) / max(count - 3, 1)
        return max(float(np.sqrt(np.median(variance))), LEAST_NOISE * self.size)
