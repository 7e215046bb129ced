"""Where a sensor may have stood, from what it measured alone."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, KDTree, QhullError

from prism_jax.geometry.cloud import sight, sphere
from prism_jax.geometry.workspace import Workspace
from prism_jax.preprocessing.segmentation.clusters import thin

NUM_DIRECTIONS = 128
MAX_POINTS, MOST = 1024, 2**14
CELLS = 32  # along each side of the image in which points hide each other
BEHIND = 0.25  # what lies so many radii of the cloud behind a point is hidden by it
# A place that is so far from the likely direction, and from which so much more of the
# points would be hidden, is not believed.
APART, HIDDEN = np.deg2rad(75.0), 0.08
DISTANCE = 6.0  # of a likely place, in radii of the cloud
# Of a closed cloud, thinned to so many cells along it and so many points, no sensor at
# so many radii sees as much, and normals cancel out but for so much; nor is its surface
# thicker than a share of its radius.
CELLS_ALONG, SAMPLE, AWAY = 48, 512, 3.0
SEEN, OPEN, THICKEST = 0.68, 0.14, 0.009
FLIP = 100.0  # the radius of the sphere that points are reflected in, in distances


def likely_eye(
    points: Float[np.ndarray, "N 3"], up: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "3"]:
    """A guess at where the sensor stood, from an object's points and perhaps the unit
    vector `up`; it can be far off.

    Of many directions it is the one in which the points cover most of an image, hide
    each other least, and bulge towards the sensor; the farther below the object, the
    less likely it is. It turns and moves with the points, up to rounding.
    """
    unit, frame = _in_own_axes(points)
    directions = sphere(NUM_DIRECTIONS)
    scores = []
    for direction in directions:
        across, along = _seen_along(unit, direction)
        covered, hidden = _shares(across, along)
        aside = ((across - across.mean(axis=0)) ** 2).sum(axis=1)
        spread = max(float(aside.std()), 1e-9)
        bulge = -((along - along.mean()) * aside).mean() / spread
        scores.append((covered, hidden, bulge))
    covered, hidden, bulge = np.array(scores).T
    likely = covered / covered.max() - hidden + bulge
    if up is not None:
        likely += np.minimum(directions @ (frame.rotation @ up), 0.0)
    best = np.argmax(likely)
    return frame.from_unit(DISTANCE * directions[best])  # pyright: ignore


def is_believable(
    points: Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"],
    likely: Float[np.ndarray, "3"],
) -> bool:
    """Whether a sensor at `eye` may have measured an object, of which `likely` is the
    `likely_eye`."""
    _, frame = _in_own_axes(points)
    one, other = frame.to_unit(np.stack([eye, likely]))
    size = np.linalg.norm(one) * np.linalg.norm(other)
    if one @ other > np.cos(APART) * size:
        return True
    return hidden_share(points, eye) - hidden_share(points, likely) <= HIDDEN


def hidden_share(
    points: Float[np.ndarray, "N 3"], eye: Float[np.ndarray, "3"]
) -> float:
    """Of the points, those that others would have hidden from a sensor at `eye`. All of
    them, if the eye is among them."""
    unit, frame = _in_own_axes(points)
    toward = frame.to_unit(np.asarray(eye, np.float64))
    distance = float(np.linalg.norm(toward))
    if distance <= 1.0:
        return 1.0
    across, along = _seen_along(unit, toward / distance)  # pyright: ignore
    # As wide as the ball is from there.
    across = across / (distance - along)[:, None] * np.sqrt(distance**2 - 1.0)
    return _shares(across, along)[1]


def is_closed(points: Float[np.ndarray, "N 3"], thickness: float = 0.0) -> bool:
    """Whether points cover an object all around, so that no side of it is missing: from
    wherever one looks much is hidden, and the normals' mean is about zero. `thickness`
    is that of the surface, its noise. A small hole, where the object stood, may remain.
    Fewer than `MAX_POINTS` points are never closed."""
    if len(points) < MAX_POINTS:
        return False
    cells = thin(points[:: -(-len(points) // MOST)], CELLS_ALONG)[0]
    rows = np.linspace(0, len(cells) - 1, min(len(cells), SAMPLE)).astype(int)
    unit, frame = _in_own_axes(cells[rows])
    if len(unit) < SAMPLE // 2 or thickness > THICKEST * float(frame.half_extent):
        return False
    toward = np.zeros_like(unit)
    for direction in sphere(NUM_DIRECTIONS)[::3]:
        seen = _seen(unit, AWAY * direction)
        if seen.mean() >= SEEN:
            return False
        toward[seen] += direction
    near = cells[KDTree(cells).query(cells[rows], k=10)[1]]
    near -= near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(near.swapaxes(1, 2) @ near)[1][..., 0]
    outward = np.sign((normals * (toward @ frame.rotation)).sum(axis=1))
    return bool(np.linalg.norm(outward @ normals) < OPEN * len(unit))


def _seen(unit: np.ndarray, eye: np.ndarray) -> Bool[np.ndarray, " N"]:
    """Which points in the unit ball an eye outside sees (Katz et al., Direct visibility
    of point sets, 2007); all of a cloud without volume."""
    toward, distance = sight(unit, eye)
    reflected = (2.0 * FLIP * distance.max() - distance)[:, None] * toward
    try:
        hull = ConvexHull(np.append(reflected, np.zeros((1, 3)), axis=0))
    except QhullError:
        return np.ones(len(unit), bool)
    return np.isin(np.arange(len(unit)), hull.vertices)


def _in_own_axes(
    points: Float[np.ndarray, "N 3"],
) -> tuple[Float[np.ndarray, "M 3"], Workspace]:
    """`MAX_POINTS` points at most in the unit ball about the middle of their box, along
    axes that turn with them, and the way there. Their principal axes, the first two in
    the direction of positive skewness."""
    points = np.asarray(points[:: -(-len(points) // MAX_POINTS)], np.float64)
    mean = points.mean(axis=0)
    around = points - mean
    axes = np.linalg.eigh(around.T @ around)[1].T
    skewness = ((around @ axes.T) ** 3).sum(axis=0)
    axes = np.where(skewness < 0, -1.0, 1.0)[:, None] * axes
    axes[2] = np.cross(axes[0], axes[1])
    along = around @ axes.T
    middle = 0.5 * (along.min(axis=0) + along.max(axis=0))
    radius = float(np.linalg.norm(along - middle, axis=1).max()) or 1.0
    frame = Workspace(mean + middle @ axes, np.array(radius), axes)
    return (along - middle) / radius, frame


def _seen_along(
    unit: np.ndarray, direction: np.ndarray
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]:
    """Coordinates across a direction, and along it."""
    axes = np.linalg.svd(direction[None])[2][1:]
    return unit @ axes.T, unit @ direction


def _shares(across: np.ndarray, along: np.ndarray) -> tuple[float, float]:
    """How much of the image the points cover, and how many of them are hidden."""
    place = np.clip(np.floor((across + 1.0) * (CELLS / 2)), 0, CELLS - 1).astype(int)
    cell = place[:, 0] * CELLS + place[:, 1]
    nearest = np.full(CELLS**2, -np.inf)
    np.maximum.at(nearest, cell, along)
    hidden = nearest[cell] - along > BEHIND
    return float(np.isfinite(nearest).mean()), float(hidden.mean())
