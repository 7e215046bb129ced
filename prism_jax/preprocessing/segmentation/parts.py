"""Which points of a scene, its planes set aside, belong to one object."""

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial import ConvexHull, KDTree, QhullError

from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.preprocessing.segmentation.clusters import (
    components,
    extent,
    linked_groups,
    thin,
)
from prism_jax.preprocessing.segmentation.planes import Plane

CELLS = 256  # along the longest side of what is split into objects
MAX_CELLS = 80_000  # half as many along the longest side if there are more
COARSE_CELLS = 16  # for distances between its parts
LINK = 3.0  # neighbours on a surface are at most so many spacings apart
# A point whose fourth neighbour is farther off than so many spacings is on no surface:
# it flies between two, beside an edge, or is a tail of the support's noise.
SPARSE = 2.0
COVERED = 0.5  # what hovers with this share over or under another part belongs to that
# What hovers no farther beside a larger part, in that part's size, belongs to it...
BESIDE = 0.15
SMALLER = 0.6  # ...if it has no more than this share of its points
MIN_CELLS = 8  # of a part that is asked where it belongs
MAX_PARTS = 100  # the largest ones are asked
TOUCH = 0.55  # of what links neighbours otherwise, across a narrow place
HIDDEN = 0.05  # a thing as high above the support, in its own height, stands on it
CREASE = 0.08  # mean slope, towards the sensor, to the neighbours in a crease
SHARE = 0.25  # of the points of two things that touch, each has at least this share
BEND_NEIGHBORS = 24  # nearest points that say how a surface is bent


def objects_of(
    points: Float64[np.ndarray, "N 3"],
    up: Float64[np.ndarray, "3"],
    eye: Float64[np.ndarray, "3"] | None,
    support: Plane | None,
    gap: float,
) -> Int[np.ndarray, " N"]:
    """The number of each point's object, without a gap from 0 on.

    Surfaces hang together where neighbours are not much farther apart than the points'
    spacing, which grows with the distance from the sensor. Things on the support that
    meet in a crease are apart. What hovers belongs to what it is above, below or close
    beside: objects hide some of themselves. So do parts no farther apart than `gap`.
    """
    cells, owner = thin(points, CELLS)
    if len(cells) > MAX_CELLS:
        cells, owner = thin(points, CELLS // 2)
    cloud = IndexedCloud(cells)
    reach, sparse = _reach(cloud, eye)
    part = _hanging_together(cloud, reach, sparse)
    height = np.full(len(cells), np.inf)
    if support is not None:
        # At zero where the support's noise or its spacing hides what touches it.
        touching = support.tolerance + np.median(reach)
        height = np.maximum(support.height(cells) - touching, 0.0)
        if eye is not None:
            part = _split_at_creases(cloud, part, reach, eye, height)
    whole = _joined(cells, part, up, height)
    if gap > 0:
        whole = _joined_across(cells, whole, gap)
    return whole[owner]


def _reach(
    cloud: IndexedCloud, eye: Float64[np.ndarray, "3"] | None
) -> tuple[Float64[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """How far the neighbours of each point on its surface can be, and which points are
    `SPARSE`: none if the sensor, and so the spacing to expect, is not known."""
    cells = cloud.points
    apart = cloud.distance(cells, 5)
    far = np.ones(len(cells))
    if eye is not None:
        far = np.maximum(np.linalg.norm(cells - eye, axis=1), 1e-300)
    usual = np.median(apart / far) * far
    # The fourth neighbour of a point in a square grid is one spacing away, or 1.4.
    reach = LINK / np.sqrt(2) * np.clip(apart, usual, 3.0 * usual)
    if eye is None:
        return reach, np.zeros(len(cells), bool)
    # What is near the sensor was thinned to one point a cell.
    return reach, apart > SPARSE * np.maximum(usual, extent(cells) / CELLS)


def _hanging_together(
    cloud: IndexedCloud,
    reach: Float64[np.ndarray, " N"],
    sparse: Bool[np.ndarray, " N"],
) -> Int[np.ndarray, " N"]:
    """Parts of points within reach of each other; sparse ones belong to what they are
    nearest to, and join nothing."""
    cells, part = cloud.points, components(cloud, np.where(sparse, 0.0, reach))
    dense = np.flatnonzero(~sparse)
    if len(dense) and sparse.any():
        apart, nearest = KDTree(cells[dense]).query(cells[sparse])
        near = apart <= reach[sparse]
        part[np.flatnonzero(sparse)[near]] = part[dense[nearest[near]]]  # pyright: ignore
    return np.unique(part, return_inverse=True)[1]


def _split_at_creases(
    cloud: IndexedCloud,
    part: Int[np.ndarray, " N"],
    reach: Float64[np.ndarray, " N"],
    eye: Float64[np.ndarray, "3"],
    height: Float64[np.ndarray, " N"],
) -> Int[np.ndarray, " N"]:
    """Parts that touch, each of which stands on the support, numbered apart."""
    cells = cloud.points
    if len(cells) <= BEND_NEIGHBORS:
        return part
    near = cloud.tree.query(cells, k=BEND_NEIGHBORS)[1]
    offsets = cells[near] - cells[:, None]
    about = cells[near] - cells[near].mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", about, about))[1][:, :, 0]
    normal *= np.sign(((eye - cells) * normal).sum(axis=1, keepdims=True))
    rise = np.einsum("nki,ni->nk", offsets, normal).mean(axis=1)
    slope = rise / np.maximum(np.linalg.norm(offsets, axis=2).mean(axis=1), 1e-300)
    smooth = slope < CREASE
    split = part.copy()
    for number in np.unique(part[height == 0.0]):
        mine = np.flatnonzero(part == number)
        core = mine[smooth[mine]]
        if len(core) == 0:
            continue
        piece = components(cells[core], TOUCH * reach[core])
        size = np.bincount(piece)
        large = _standing(piece, height[core]) & (size >= SHARE * len(mine))
        if large.sum() < 2:
            continue
        core, piece = core[large[piece]], piece[large[piece]]
        nearest = KDTree(cells[core]).query(cells[mine])[1]
        split[mine] = split.max() + 1 + piece[nearest]
    return np.unique(split, return_inverse=True)[1]


def _standing(
    part: Int[np.ndarray, " N"], height: Float64[np.ndarray, " N"]
) -> Bool[np.ndarray, " P"]:
    """Which parts reach down to the support, but for what they hide of themselves."""
    foot, top = np.full((2, part.max() + 1), [[np.inf], [0.0]])
    np.minimum.at(foot, part, height)
    np.maximum.at(top, part, height)
    return np.isfinite(top) & (foot <= HIDDEN * top)


def _joined(
    cells: Float64[np.ndarray, "N 3"],
    part: Int[np.ndarray, " N"],
    up: Float64[np.ndarray, "3"],
    height: Float64[np.ndarray, " N"],
) -> Int[np.ndarray, " N"]:
    """Parts that hover, with what they are above, below or close beside."""
    size = np.bincount(part)
    on_foot = _standing(part, height)
    asked = np.argsort(-size, kind="stable")[:MAX_PARTS]
    asked = asked[size[asked] >= MIN_CELLS]
    flat = cells @ np.linalg.svd(up[None])[2][1:].T
    where = {number: np.flatnonzero(part == number) for number in asked}
    hulls = {number: _hull(flat[where[number]]) for number in asked}
    pairs = []
    for rank, large in enumerate(asked):
        others = IndexedCloud(cells[where[large]])
        near = BESIDE * np.ptp(cells[where[large]], axis=0).max()
        for small in asked[rank + 1 :]:
            if on_foot[large] and on_foot[small]:
                continue
            over = max(
                _share_within(flat[where[small]], hulls[large]),
                _share_within(flat[where[large]], hulls[small]),
            )
            beside = not on_foot[small] and size[small] <= SMALLER * size[large]
            if over >= COVERED or (
                beside and others.distance(cells[where[small]]).min() <= near
            ):
                pairs.append((large, small))
    return linked_groups(np.array(pairs, int).reshape(-1, 2), len(size))[part]


def _joined_across(
    cells: Float64[np.ndarray, "N 3"], part: Int[np.ndarray, " N"], gap: float
) -> Int[np.ndarray, " N"]:
    """Parts no farther apart than about `gap`, together."""
    coarse, owner = thin(cells, COARSE_CELLS)
    pairs = KDTree(coarse).query_pairs(gap, output_type="ndarray")
    member = np.stack([owner, len(coarse) + part], axis=1)
    count = len(coarse) + int(part.max()) + 1
    together = linked_groups(np.concatenate([pairs, member]), count)
    return np.unique(together[owner], return_inverse=True)[1]


def _hull(flat: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "E 3"]:
    """The sides of the convex hull; where it has no area, one that all are beyond."""
    try:
        return ConvexHull(flat).equations
    except (QhullError, ValueError):
        return np.array([[0.0, 0.0, np.inf]])


def _share_within(
    flat: Float64[np.ndarray, "N 2"], hull: Float64[np.ndarray, "E 3"]
) -> float:
    outside = (flat @ hull[:, :2].T + hull[:, 2]).max(axis=1)
    return float((outside <= 0).mean())
