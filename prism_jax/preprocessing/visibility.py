"""What lies before, behind and beside a measured surface, as its sensor saw it."""

import numpy as np
from jaxtyping import Bool, Float

from prism_jax.geometry.cloud import IndexedCloud, sight

IN_FRONT = 4.0
"""In spacings of the network's input: a point that much nearer to the sensor than all
that was measured about its line of sight would have hidden it."""

PAST = 5.0
"""In spacings of the network's input: nothing measured as near to a point's line of
sight means that the sensor looked through it, or away from it."""

NUM_RAYS = 8  # measured points about a line of sight that are asked

SIGHT_REACH = 3.0  # in spacings: nearer lines of sight are neighbours


def in_front(
    points: Float[np.ndarray, "P 3"],
    measured: IndexedCloud | Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"],
    spacing: float,
    tolerance: float,
) -> Bool[np.ndarray, " P"]:
    """Which points would have hidden a measured surface from a sensor at `eye`.

    `spacing` is the usual distance between measured neighbours. A point is in front if
    something was measured about its line of sight, within `SIGHT_REACH` spacings at the
    measured surface's usual distance, and all of it more than `tolerance` spacings
    farther from the sensor. Behind the surface, and where nothing was measured, none
    is.

    All in one frame and unit of length. NumPy, not differentiable. Of two clouds of
    which one is empty no point is in front.
    """
    if len(points) == 0 or len(measured) == 0:
        return np.zeros(len(points), bool)
    tree, distance = IndexedCloud.of(measured).sights(eye)
    wanted, away = sight(points, eye)
    reach = SIGHT_REACH * spacing / np.median(distance)
    apart, rows = tree.query(wanted, k=NUM_RAYS, distance_upper_bound=reach)
    near = np.isfinite(apart)
    farther = np.append(distance, np.inf)[rows] - away[:, None] > tolerance * spacing
    return near.any(axis=1) & (farther | ~near).all(axis=1)


def looked_through(
    points: Float[np.ndarray, "P 3"],
    measured: IndexedCloud | Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"],
    reach: float,
) -> Bool[np.ndarray, " P"]:
    """Points about whose line of sight nothing was measured, from a sensor at `eye`.

    Within `reach`, at the measured surface's usual distance. The sensor looked through
    such a point, or away from it. Of no measured points it looked through all.
    """
    if len(points) == 0 or len(measured) == 0:
        return np.ones(len(points), bool)
    tree, distance = IndexedCloud.of(measured).sights(eye)
    return tree.query(sight(points, eye)[0])[0] > reach / np.median(distance)


def beside_and_behind(
    points: Float[np.ndarray, "P 3"],
    measured: IndexedCloud | Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """How far each point's line of sight passes what a sensor at `eye` measured, and
    how far behind that the point lies, negative in front.

    The first is the distance from the silhouette for points beside it, and no more than
    the points' spacing for others: between the directions of the point and of the
    measured one nearest to it, at the latter's distance. All in one frame and unit of
    length; at least one was measured. NumPy, not differentiable.
    """
    tree, distance = IndexedCloud.of(measured).sights(eye)
    wanted, away = sight(points, eye)
    apart, row = tree.query(wanted)
    return apart * distance[row], away - distance[row]
