"""Whether a sensor looks at a scene, and which planes are its floor and walls."""

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.spatial import KDTree

from prism_jax.geometry.cloud import IndexedCloud, sight
from prism_jax.preprocessing.segmentation.planes import Plane, Thinned

MOST = 20_000  # points that are asked, of a larger cloud
# The mean of the directions to all points is shorter where the sensor sees a wide view,
# over 50 x 40 degrees, and where they lie all around it.
WIDE, AROUND = 0.955, 0.8
BEHIND = 0.03  # of all points, no more lie behind a plane that ends the view
BOUNDED, RIM = 0.45, 0.6  # shares of the points, and of the view's rim, on such planes
# Of all points, so many lie on a level plane and the others above it: a floor. Chosen
# on validation, where no view of one object is so.
FLOOR, LEVEL = 0.8, 0.95
# Of a sweep, spacing grows with range, nearly every neighbour in direction is about as
# far away, and no point is close to the sensor, in the median range.
GROWTH, SMOOTH, CLEAR = 0.5, 0.85, 0.15


def sees_scene(
    points: Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"] | None = None,
    up: Float[np.ndarray, "3"] | None = None,
) -> bool:
    """Whether a sensor at `eye` looks at a scene, not at one object: planes end a wide
    view, or the points lie all around it, or nearly all on a floor, if `up` is known.
    Without an eye the sensor may stand at the origin; an object about the origin is
    then no scene."""
    at = np.zeros(3) if eye is None else eye
    thinned = Thinned(IndexedCloud.of_enough(points, MOST).points)
    if up is not None and _on_floor(thinned, up):
        return True
    length = np.linalg.norm(sight(thinned.cells.points, at)[0].mean(axis=0))
    if length >= WIDE or (length >= AROUND and not bounding(thinned, at)):
        return False
    return eye is not None or is_sweep(thinned.points)


def bounding(thinned: Thinned, eye: Float[np.ndarray, "3"]) -> list[Plane]:
    """Which planes are the floor and the walls that a sensor's whole view ends at.

    Next to nothing lies behind them. None are unless the view is wide and they hold
    much of it, and of its rim: planes of an object end within the view.
    """
    cells = thinned.cells.points
    toward = sight(cells, eye)[0]
    forward = toward.sum(axis=0) / max(len(cells), 1)
    length = np.linalg.norm(forward)
    if length >= WIDE or len(cells) == 0:
        return []
    on, found = np.zeros(len(cells), bool), []
    for plane in thinned.planes:
        height = plane.height(cells) * np.sign(plane.height(eye[None])[0])
        if (height < -2.0 * plane.tolerance).mean() <= BEHIND:
            found.append(plane)
            on |= height <= 2.0 * plane.tolerance
    rim = on if length < AROUND else on[_rim(toward, forward / length)]
    return found if on.mean() >= BOUNDED and rim.mean() >= RIM else []


def _on_floor(thinned: Thinned, up: Float[np.ndarray, "3"]) -> bool:
    """Whether most points lie on a level plane, and all others above it."""
    cells = thinned.cells.points
    for plane in thinned.planes:
        facing = float(plane.normal @ up)
        height = np.sign(facing) * plane.height(cells)
        above, below = height > 2 * plane.tolerance, height < -2 * plane.tolerance
        is_lowest = abs(facing) >= LEVEL and below.mean() <= BEHIND
        if is_lowest and 0 < above.mean() <= 1.0 - FLOOR:
            return True
    return False


def is_sweep(points: Float64[np.ndarray, "N 3"]) -> bool:
    """Whether points on the sides of the origin were measured from there."""
    toward, far = sight(points, np.zeros(3))
    if len(points) < 64 or np.quantile(far, 0.01) < CLEAR * np.median(far):
        return False
    nearest = np.asarray(KDTree(toward).query(toward, k=2)[1])[:, 1]
    if (np.abs(np.log(far / far[nearest])) < 0.2).mean() < SMOOTH:
        return False
    spacing = np.asarray(KDTree(points).query(points, k=5)[0])[:, 4]
    growth = np.cov(np.log(far), np.log(np.maximum(spacing, 1e-300)))
    return bool(growth[0, 1] > GROWTH * growth[0, 0] > 0)


def _rim(
    toward: Float64[np.ndarray, "N 3"], forward: Float64[np.ndarray, "3"]
) -> Int[np.ndarray, " R"]:
    """The outermost direction in each of 72 ways around the middle of them."""
    across = toward @ np.linalg.svd(forward[None])[2][1:].T
    across -= np.median(across, axis=0)
    way = np.floor(np.arctan2(across[:, 1], across[:, 0]) / np.pi * 36)
    outward = np.argsort(-np.linalg.norm(across, axis=1), kind="stable")
    return outward[np.unique(way[outward], return_index=True)[1]]
