"""How far each predicted point is expected to lie from the true surface."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.preprocessing.observation import Observation
from prism_jax.preprocessing.visibility import beside_and_behind
from prism_jax.uncertainty.evidence import PLANE_NEIGHBORS, Looks, asked, roughness
from prism_jax.uncertainty.trees import Trees

CLUES = (
    "measured",  # distance from the nearest measured point
    "measured_8",  # and from the eighth nearest of those that the network read
    "predicted_2",  # distance from the second nearest predicted point
    "predicted_8",  # and from the eighth
    "thickness",  # of the predicted points about it, across their plane
    "slant",  # cosine of the angle between its line of sight and that plane's normal
    "mirrored",  # distance from the completion of the mirror image
    "turned",  # and of the quarter turn
    "all_mirrored",  # the mean of that over all points that are asked about
    "all_turned",
    "all_measured",
    "beside",  # distance of its line of sight from what was measured
    "behind",  # how far behind what was measured it lies, negative in front
    "height",  # above the workspace's centre
    "centre",  # distance from the workspace's centre
    "outside",  # of the box of what was measured, negative inside
    "middle_side",  # of that box, in the longest
    "shortest_side",
    "num_points",  # that were measured
    "spacing",  # of what the network read
    "roughness",  # of what was measured
    "unexplained",  # mean distance of measured points from the nearest predicted one
)
"""What the error of a predicted point is told from, without the truth. Lengths are in
half sides of the workspace."""

BETWEEN = 3  # predicted points that say how far off one is that was added between them


@dataclasses.dataclass(frozen=True)
class PointErrors(Trees):
    """What gives each predicted point its sigma: trees over `CLUES`, whose sum is the
    logarithm of the expected distance from the true surface.

    `experiments.calibrate` fits them on validation data that is shifted in every
    way. Lengths are in half sides of the workspace.
    """

    WHAT: ClassVar[str] = "an estimate of points' errors"
    NAMES: ClassVar[tuple[str, ...]] = CLUES

    def sigma(self, clues: Float[np.ndarray, "P C"]) -> Float[np.ndarray, " P"]:
        """The expected (mean) distance of each point from the true surface."""
        return np.exp(np.clip(self.sums(clues), *self.bounds))


def clues_of(
    points: Float[np.ndarray, "Q 3"],
    seen: Observation,
    read: Observation,
    prediction: IndexedCloud | Float[np.ndarray, "P 3"],
    looks: Looks,
) -> Float[np.ndarray, "Q C"]:
    """`CLUES` of some of the predicted points, a row for each.

    `seen` and `read` are what was observed and what the network read of it, of at least
    one point inside; `prediction` is its output, adapted or not, and `looks` what it
    was in each pose before it adapted. All in the unit workspace. NumPy, the same bits
    for the same input, finite for any cloud: neighbours that there are not are the
    farthest there is.
    """
    if len(points) == 0:
        return np.zeros((0, len(CLUES)))
    measured, partial, prediction = seen.cloud, read.cloud, IndexedCloud.of(prediction)
    eye = np.asarray(seen.eye, np.float64)
    lower, upper = measured.points.min(axis=0), measured.points.max(axis=0)
    sides = np.sort(upper - lower)
    longest = sides[2] or 1.0
    near = prediction.tree.query(points, k=min(PLANE_NEIGHBORS, len(prediction)))[1]
    near = prediction.points[np.reshape(near, (len(points), -1))]
    normals, thickness = _planes(near)
    ray = points - eye
    length = np.maximum(np.linalg.norm(ray, axis=1), np.finfo(np.float64).tiny)
    beside, behind = beside_and_behind(points, measured.distinct, eye)
    mirrored, turned = (look.distance(points) for look in looks[1:])
    known = measured.distance(points)
    found = {
        "measured": known,
        "measured_8": partial.distinct.distance(points, 8),
        "predicted_2": np.linalg.norm(near[:, :3][:, -1] - points, axis=1),
        "predicted_8": np.linalg.norm(near[:, :9][:, -1] - points, axis=1),
        "thickness": thickness,
        "slant": np.abs(np.einsum("pi,pi->p", normals, ray)) / length,
        "mirrored": mirrored,
        "turned": turned,
        "all_mirrored": mirrored.mean(),
        "all_turned": turned.mean(),
        "all_measured": known.mean(),
        "beside": beside,
        "behind": behind,
        "height": points[:, 2],
        "centre": np.linalg.norm(points, axis=1),
        "outside": np.maximum(lower - points, points - upper).max(axis=1),
        "middle_side": sides[1] / longest,
        "shortest_side": sides[0] / longest,
        "num_points": len(measured.distinct),
        "spacing": min(partial.spacing, 1.0),
        "roughness": roughness(measured),
        "unexplained": prediction.distance(asked(measured)).mean(),
    }
    columns = [np.broadcast_to(found[name], len(points)) for name in CLUES]
    # As float32, in which they are fitted: a threshold means the same there and here.
    return np.stack(columns, axis=1).astype(np.float32).astype(np.float64)


def spread(
    points: Float[np.ndarray, "Q 3"],
    known: IndexedCloud | Float[np.ndarray, "P 3"],
    sigma: Float[np.ndarray, " P"],
) -> Float[np.ndarray, " Q"]:
    """The sigma of points that were added between others whose sigma is known.

    The mean of the nearest, weighted by the inverse of their distances: exact at the
    known points. Of no known point nothing is known, and NaN is returned.
    """
    if len(known) == 0:
        return np.full(len(points), np.nan)
    count = min(BETWEEN, len(known))
    apart, rows = IndexedCloud.of(known).tree.query(points, k=count)
    apart, rows = np.reshape(apart, (-1, count)), np.reshape(rows, (-1, count))
    # Relative to the nearest, so that no unit of length and no copy is special.
    nearest = apart[:, :1]
    weights = np.where(apart > nearest, nearest / np.where(apart > 0, apart, 1.0), 1.0)
    return (weights * sigma[rows]).sum(axis=1) / weights.sum(axis=1)


def _planes(
    near: Float[np.ndarray, "Q K 3"],
) -> tuple[Float[np.ndarray, "Q 3"], Float[np.ndarray, " Q"]]:
    """Normals of the planes through some points, and how far these lie off them."""
    offsets = near - near.mean(axis=1, keepdims=True)
    squares = np.einsum("nki,nkj->nij", offsets, offsets) / near.shape[1]
    values, vectors = np.linalg.eigh(squares)
    return vectors[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0.0))
