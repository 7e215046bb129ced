"""Whether a sensor looks at a scene, and which planes are its floor and walls."""

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial import KDTree

from prism_jax.preprocessing.segmentation.planes import Plane, Thinned

MOST = 20_000  # points that are asked, of a larger cloud
# The mean of the directions to all points is shorter where the sensor sees a wide view,
# over 50 x 40 degrees, and where they lie all around it.
WIDE, AROUND = 0.955, 0.8
BEHIND = 0.03  # of all points, no more lie behind a plane that bounds the view
BOUNDED, RIM = 0.45, 0.6  # shares of the points, and of the view's rim, on such planes
# Of a sweep, spacing grows with range, nearly every neighbour in direction is about as
# far away, and no point is close to the sensor, in the median range.
GROWTH, SMOOTH, CLEAR = 0.5, 0.85, 0.15


def sees_scene(
    points: Float[np.ndarray, "N 3"], eye: Float[np.ndarray, "3"] | None = None
) -> bool:
    """Whether a sensor at `eye` looks at a scene, not at one object: planes bound a
    wide view, or the points lie all around it. Without an eye the sensor may stand at
    the origin; an object about the origin is then no scene."""
    if len(points) > MOST:
        rng = np.random.default_rng(0)
        points = points[rng.choice(len(points), MOST, replace=False, shuffle=False)]
    points = np.asarray(points, np.float64)
    at = np.zeros(3) if eye is None else np.asarray(eye, np.float64)
    thinned = Thinned(points)
    length = np.linalg.norm(_directions(thinned.cells.points, at).mean(axis=0))
    if length >= WIDE or (length >= AROUND and not bounding(thinned, at)):
        return False
    return eye is not None or is_sweep(points)


def bounding(thinned: Thinned, eye: Float64[np.ndarray, "3"]) -> list[Plane]:
    """Which planes are the floor and the walls that a sensor's whole view ends at.

    Next to nothing lies behind them. None are unless the view is wide and they hold
    much of it, and of its rim: nothing else sticks out on most sides. Planes of an
    object end within the view.
    """
    cells = thinned.cells.points
    if len(cells) == 0:
        return []
    toward = _directions(cells, eye)
    forward = toward.mean(axis=0)
    length = np.linalg.norm(forward)
    if length >= WIDE:
        return []
    planes = thinned.planes
    on, found = np.zeros(len(cells), bool), []
    for plane in planes:
        height = plane.height(cells) * np.sign(plane.height(eye[None])[0])
        if (height < -2.0 * plane.tolerance).mean() <= BEHIND:
            found.append(plane)
            on |= height <= 2.0 * plane.tolerance
    if on.mean() < BOUNDED:
        return []
    if length >= AROUND and on[_rim(toward, forward / length)].mean() < RIM:
        return []
    return found


def is_sweep(points: Float[np.ndarray, "N 3"]) -> bool:
    """Whether points on the sides of the origin were measured from there."""
    range_ = np.linalg.norm(points, axis=1)
    points, range_ = points[range_ > 0], range_[range_ > 0]
    if len(points) < 64 or np.quantile(range_, 0.01) < CLEAR * np.median(range_):
        return False
    nearest = KDTree(points / range_[:, None]).query(points / range_[:, None], k=2)[1]
    ratio = np.log(range_ / range_[np.asarray(nearest)[:, 1]])
    if (np.abs(ratio) < 0.2).mean() < SMOOTH:
        return False
    spacing = np.asarray(KDTree(points).query(points, k=5)[0])[:, 4]
    far, apart = np.log(range_), np.log(np.maximum(spacing, 1e-300))
    return bool(np.cov(far, apart)[0, 1] > GROWTH * far.var() > 0)


def _directions(
    points: Float64[np.ndarray, "N 3"], eye: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "N 3"]:
    away = points - eye
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)


def _rim(
    toward: Float64[np.ndarray, "N 3"], forward: Float64[np.ndarray, "3"]
) -> Bool[np.ndarray, " N"]:
    """The outermost of the directions, in each of 72 ways around the middle one."""
    across = toward @ np.linalg.svd(forward[None])[2][1:].T
    across /= np.linalg.norm(across, axis=1, keepdims=True).clip(1e-300)
    across *= np.arccos(np.clip(toward @ forward, -1, 1))[:, None]
    across -= np.median(across, axis=0)
    turn = np.arctan2(across[:, 1], across[:, 0])
    way = np.clip(np.floor((turn / np.pi + 1.0) * 36), 0, 71).astype(int)
    order = np.argsort(np.linalg.norm(across, axis=1), kind="stable")
    outermost = np.full(72, -1)
    outermost[way[order]] = order
    rim = np.zeros(len(toward), bool)
    rim[outermost[outermost >= 0]] = True
    return rim
