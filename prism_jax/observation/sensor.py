"""Where a sensor may have stood, from what it measured alone."""

import numpy as np
from jaxtyping import Float

NUM_DIRECTIONS = 128
MAX_POINTS = 1024
CELLS = 32
"""Along each side of the image in which points hide each other."""

BEHIND = 0.25
"""In radii of the cloud: what lies that much behind another point is hidden by it."""

APART, HIDDEN = np.deg2rad(75.0), 0.08
"""A place that is so far from the likely direction, and from which so much more of the
points would be hidden, is not believed."""

DISTANCE = 6.0
"""Of a likely place, in radii of the cloud."""


def likely_eye(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3"]:
    """The place of a sensor that may have measured an object of which nothing else is
    known.

    Of many directions it is the one in which the points cover most of an image, hide
    each other least, and bulge towards the sensor. It is a guess, and can be far off.
    In the points' frame; NumPy, not differentiable.
    """
    points = _some(points)
    center, radius = _ball(points)
    unit = (points - center) / radius
    directions = _directions()
    scores = []
    for direction in directions:
        across, along = _seen_along(unit, direction)
        nearest, cell = _nearest(across, along)
        covered = np.isfinite(nearest).sum() / CELLS**2
        hidden = (nearest[cell] - along > BEHIND).mean()
        aside = ((across - across.mean(axis=0)) ** 2).sum(axis=1)
        spread = max(float(aside.std()), 1e-9)
        bulge = -((along - along.mean()) * aside).mean() / spread
        scores.append((covered, hidden, bulge))
    covered, hidden, bulge = np.array(scores).T
    best = np.argmax(covered / covered.max() - hidden + bulge)
    return center + DISTANCE * radius * directions[best]


def is_believable(
    points: Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"],
    likely: Float[np.ndarray, "3"],
) -> bool:
    """Whether a sensor at `eye` may have measured an object, of which `likely` is the
    `likely_eye`."""
    center, _ = _ball(points)
    one, other = eye - center, likely - center
    size = np.linalg.norm(one) * np.linalg.norm(other)
    if one @ other > np.cos(APART) * size:
        return True
    return hidden_share(points, eye) - hidden_share(points, likely) <= HIDDEN


def hidden_share(
    points: Float[np.ndarray, "N 3"], eye: Float[np.ndarray, "3"]
) -> float:
    """Of the points, those that others would have hidden from a sensor at `eye`.

    All of them, if the eye is among them.
    """
    points = _some(points)
    center, radius = _ball(points)
    toward = (np.asarray(eye, np.float64) - center) / radius
    distance = float(np.linalg.norm(toward))
    if distance <= 1.0:
        return 1.0
    across, along = _seen_along((points - center) / radius, toward / distance)
    # As wide as the ball is from there.
    across = across / (distance - along)[:, None] * np.sqrt(distance**2 - 1.0)
    nearest, cell = _nearest(across, along)
    return float((nearest[cell] - along > BEHIND).mean())


def _some(points: np.ndarray) -> Float[np.ndarray, "M 3"]:
    every = -(-len(points) // MAX_POINTS)
    return np.asarray(points[::every], np.float64)


def _ball(points: np.ndarray) -> tuple[Float[np.ndarray, "3"], float]:
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - center, axis=1).max())
    return center, max(radius, np.finfo(np.float64).tiny)


def _directions() -> Float[np.ndarray, "D 3"]:
    """Evenly over a sphere: a Fibonacci lattice."""
    rows = np.arange(NUM_DIRECTIONS) + 0.5
    z = 1.0 - 2.0 * rows / NUM_DIRECTIONS
    turn = np.pi * (1 + 5**0.5) * rows
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _seen_along(
    unit: np.ndarray, direction: np.ndarray
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]:
    """Coordinates across a direction, and along it."""
    axes = np.linalg.svd(direction[None])[2][1:]
    return unit @ axes.T, unit @ direction


def _nearest(
    across: np.ndarray, along: np.ndarray
) -> tuple[Float[np.ndarray, " C"], np.ndarray]:
    """The largest coordinate along the direction in each cell of the image, and the
    cell of each point."""
    place = np.clip(np.floor((across + 1.0) * (CELLS / 2)), 0, CELLS - 1).astype(int)
    cell = place[:, 0] * CELLS + place[:, 1]
    nearest = np.full(CELLS**2, -np.inf)
    np.maximum.at(nearest, cell, along)
    return nearest, cell
