"""Which predicted points a user gets beside the measured ones, and how many."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from prism_jax.geometry.cloud import IndexedCloud, cell_codes
from prism_jax.geometry.visibility import Background, Visibility
from prism_jax.preprocessing.visibility import IN_FRONT, PAST, in_front, looked_through
from prism_jax.preprocessing.visibility_map import in_free_space

STRAY = 0.35
"""Of a predicted point that is no stray so many others (`min_neighbors`), predicted or
measured, are no farther off, in the unit workspace. Chosen on validation
(docs/findings.md), as that number is."""

NEW = 0.5  # spacings of the input; what is nearer to a measured point is not new

MAX_DENSE = 200_000  # points that `densify` makes at most

LONG_EDGE = 2.0  # in usual spacings: points farther apart span no surface

NUM_EDGES = 6  # nearest neighbours of a point that edges lead to


Points = IndexedCloud | Float[Array | np.ndarray, "_ 3"]


class Selection(NamedTuple):
    """What became of each predicted point."""

    kept: Bool[np.ndarray, " P"]  # it is added to the measured points
    outside: Bool[np.ndarray, " P"]  # it lies outside the workspace
    stray: Bool[np.ndarray, " P"]  # it lies alone, or with few (`STRAY`)
    # It would have hidden what was measured behind it (`IN_FRONT`).
    in_front: Bool[np.ndarray, " P"]
    # The sensor saw nothing of the object about its line of sight (`PAST`), and
    # something else behind it, or what lies around is known to be empty.
    looked_through: Bool[np.ndarray, " P"]
    known: Bool[np.ndarray, " P"]  # it says nothing new, so near is a measured point


def added_points(
    prediction: Points,
    measured: Points,
    partial: Points,
    eye: Float[np.ndarray, "3"] | None,
    density: float = 1.0,
    background: Background = "unknown",
    visibility: Visibility | None = None,
) -> tuple[Float[np.ndarray, "Q 3"], IndexedCloud, Selection]:
    """What a user gets beside the measured points, which of these the network
    predicted, and what became of each that it predicted.

    Those that `select` keeps, and between them so many more that all are `density`
    times as dense as the measured ones, where they are not so anyway; 0 leaves them as
    predicted. All in the unit workspace, and within it.
    """
    prediction, measured = IndexedCloud.of(prediction), IndexedCloud.of(measured)
    selection = select(prediction, measured, partial, eye, background, visibility)
    kept = IndexedCloud(prediction.points[selection.kept])
    if density == 0 or kept.density == 0:
        return kept.points, kept, selection
    dense = densify(kept, density * measured.density / kept.density)
    return dense[(np.abs(dense) <= 1.0).all(axis=1)], kept, selection


def select(
    prediction: Points,
    measured: Points,
    partial: Points,
    eye: Float[np.ndarray, "3"] | None,
    background: Background = "unknown",
    visibility: Visibility | None = None,
) -> Selection:
    """Which predicted points to add to the measured ones.

    Those in the workspace, in company, where nothing was measured, and none that hides
    what was measured from the sensor at `eye` (None if nobody knows where it stood).
    `partial` is what the network read. All in the unit workspace.

    A sensor that seems to have looked through a point is a reason to leave it out only
    if the `background` is empty, or where the `visibility` says that something else was
    measured behind it (`prism_jax.preprocessing.visibility_map.seen_among`). In cropped
    views and full cells the sensor missed points for other reasons.
    """
    prediction, measured = IndexedCloud.of(prediction), IndexedCloud.of(measured)
    spacing, points = IndexedCloud.of(partial).spacing, prediction.points
    outside = np.asarray(~(np.abs(points) <= 1.0).all(axis=1))
    stray = outlier_mask(prediction, measured)
    hides = through = np.zeros(len(points), bool)
    if eye is not None:
        hides = in_front(points, measured, eye, spacing, IN_FRONT)
        past = np.full(len(points), background == "empty")
        if visibility is not None:
            past |= in_free_space(points, visibility, IN_FRONT * spacing)
        if past.any():
            through = past & looked_through(points, measured, eye, PAST * spacing)
    old = measured.distance(points) <= NEW * spacing
    kept = ~(outside | stray | hides | through | old)
    return Selection(kept, outside, stray, hides, through, old)


def densify(points: Points, times: float) -> Float[np.ndarray, "Q 3"]:
    """The points, and between them so many more that there are `times` as many.

    New points halve the edges between near neighbours, so they lie on the surface that
    those span, and none where the cloud has a gap. The given points come first. It
    never returns fewer than these, and never more than `MAX_DENSE` unless these are.
    """
    dense = IndexedCloud.of(points)
    reach = dense.spacing
    if not np.isfinite(reach):
        return dense.points
    wanted = max(len(dense), int(min(MAX_DENSE, np.ceil(len(dense) * times))))
    rng = np.random.default_rng(0)
    while len(dense) < wanted:
        middles = _middles(dense, LONG_EDGE * reach)
        if len(middles) == 0:
            break
        dense = IndexedCloud(np.concatenate([dense.points, rng.permutation(middles)]))
        reach *= 0.5
    return dense.points[:wanted]


def min_neighbors(num_points: int) -> int:
    """How many points a predicted point that is no stray has near it (`STRAY`), in a
    prediction of so many: 12 in three poses of 2,048 points, 4 in one, and never fewer
    than 2."""
    return max(2, round(num_points / 512))


def outlier_mask(
    prediction: Points, measured: Points, reach: float = STRAY
) -> Bool[np.ndarray, " P"]:
    """Points of a prediction that fewer than `min_neighbors` others of either cloud are
    near."""
    prediction, measured = IndexedCloud.of(prediction), IndexedCloud.of(measured)
    count = min_neighbors(len(prediction))
    # The first is the point itself.
    nearest: Any = range(1, count + 2)
    clouds = (prediction, measured)
    apart = [cloud.tree.query(prediction.points, nearest)[0] for cloud in clouds]
    return ~(np.sort(np.concatenate(apart, axis=1))[:, count] <= reach)


def _middles(cloud: IndexedCloud, longest: float) -> Float[np.ndarray, "M 3"]:
    """Middles of edges between near neighbours, no two of them close together."""
    points = cloud.points
    apart, rows = cloud.tree.query(points, k=NUM_EDGES + 1)
    first = np.repeat(np.arange(len(points)), NUM_EDGES)
    second, length = np.asarray(rows)[:, 1:].ravel(), apart[:, 1:].ravel()
    # A missing neighbour is infinitely far away.
    edges = np.flatnonzero((length > 0) & (length <= longest))
    if len(edges) == 0:
        return points[:0]
    pairs = np.sort([first[edges], second[edges]], axis=0).T
    one, other = pairs[np.unique(cell_codes(pairs), return_index=True)[1]].T
    middles = 0.5 * (points[one] + points[other])
    cells = cell_codes(np.floor(middles / (0.2 * longest)).astype(np.int64))
    return middles[np.unique(cells, return_index=True)[1]]
