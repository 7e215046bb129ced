"""Points thinned to one a cell, and what hangs together among them."""

from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from prism_jax.geometry.cloud import IndexedCloud, cell_codes

CELLS = 128  # along the longest side of a cloud's bulk
MAX_GRID = 2**24  # cells, occupied or not, that are counted
LINK_NEIGHBORS = 16  # so many nearest points can be linked to one


def thin(
    points: Float[np.ndarray, "N 3"], cells: int = CELLS
) -> tuple[Float64[np.ndarray, "M 3"], Int[np.ndarray, " N"]]:
    """The mean of the points in each occupied cell of a grid, and each point's cell.

    The `extent` is so many `cells` long. A surface then weighs as much as it has area,
    however near the sensor it is.
    """
    points = np.asarray(points, np.float64)
    if len(points) == 0:
        return points, np.zeros(0, int)
    origin = np.median(points, axis=0)
    around = points - origin
    side = extent(around)
    scale = cells / side if side > 0 else 0.0
    index = np.clip(np.floor(around * scale), -(2**20), 2**20 - 1).astype(np.int64)
    code = cell_codes(index)
    if code.max() < MAX_GRID:  # counting is faster than sorting
        owner = (np.cumsum(np.bincount(code) > 0) - 1)[code]
    else:
        _, owner = np.unique(code, return_inverse=True)
    counts = np.bincount(owner)
    sums = [np.bincount(owner, column) for column in around.T]
    return origin + np.stack(sums, axis=1) / counts[:, None], owner


def extent(points: Float64[np.ndarray, "N D"]) -> float:
    """The longest side of the bulk: without a hundredth at each end of each axis. Of
    all points where that is nothing."""
    if len(points) == 0:
        return 0.0
    rank = len(points) // 100
    last = len(points) - 1 - rank
    ordered = np.partition(points, (rank, last), axis=0)
    side = (ordered[last] - ordered[rank]).max()
    return float(side if side > 0 else np.ptp(points, axis=0).max())


def components(
    points: IndexedCloud | Float64[np.ndarray, "N D"], reach: Float64[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """Numbers of connected groups; two points within both their reaches are linked.
    Only the `LINK_NEIGHBORS` nearest of each point are asked."""
    if len(points) < 2:
        return np.zeros(len(points), int)
    cloud = IndexedCloud.of(points)
    found: Any = cloud.tree.query(
        cloud.points, LINK_NEIGHBORS + 1, distance_upper_bound=1.001 * reach.max()
    )
    apart, other = found
    linked = np.isfinite(apart)
    one = np.broadcast_to(np.arange(len(points))[:, None], other.shape)[linked]
    other, apart = other[linked], apart[linked]
    near = apart <= np.minimum(reach[one], reach[other])
    return linked_groups(np.stack([one[near], other[near]], axis=1), len(points))


def linked_groups(pairs: Int[np.ndarray, "P 2"], count: int) -> Int[np.ndarray, " M"]:
    """The group of each of `count` things, which pairs connect."""
    links = np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])
    graph = coo_array(links, shape=(count, count))
    return connected_components(graph, directed=False)[1]
