"""Where a model lies in a scan: poses by pairs of points, the best of them refined."""

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from prism_jax.io.errors import require
from prism_jax.registration.scan import Scan
from prism_jax.registration.surface import FEWER, Front, Surface, pair_codes

HYPOTHESES, PER_PAIR = 3000, 12  # poses by pairs, and at most of one pair of the scan
HEADINGS = 36
JUDGED, KEPT = (32, 200), 150  # points that judge poses in turn, and what they keep
TRIED, REFINED = 3, 12  # poses of any model, and of those that are looked at closely
REACH = 0.06  # of a model's point, in longest sides, in the search
NEAR = 0.1, 0.03  # in longest sides: what is refined, step by step
FITS = 3.0  # in the sensor's noise: nearer points lie on the model
AGREE = 0.4  # least cosine between the normals of what lies together
REFINING, RANKED = 400, 10  # points that refine poses; one in so many ranks them
SETTLED = (10, 4 * (0.03,) + 2 * (0.02,)), (3, 3 * (0.01,))
ASIDE, AHEAD = 0.015, 0.01
"""One measured point in so many settles poses by planes so near, in longest sides. Of
starts so far aside one is kept that is so much better, in missed points."""
LOOSE = 0.01  # radians, and longest sides
NEIGHBORS = 8  # points of the surface, of which one explains a measured point
FLAT = 1.8  # in spacings of the surface: so far its points stand for their planes
ROUGHLY, EXACTLY = 0.05, 0.01  # in longest sides: poses nearer to each other are one
STILL = 1e-3  # in radians and in longest sides: a smaller step of a refinement ends it


def search(
    scan: Scan, surface: Surface, up: Float[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "H 4 4"], float]:
    """Different poses of a model in a scan, likeliest first, and how well the points
    lie on it in the best: 1 if all do. It may stand upright, its z along `up`, or lie
    anyhow. Poses lead from the scan's frame, about its middle, to the surface's."""
    poses = np.concatenate([by_pairs(scan, surface), by_headings(scan, surface, up)])
    for count in JUDGED:
        scores = _scores(scan, surface, poses, count)
        poses = poses[np.argsort(-scores, kind="stable")[:KEPT]]
    poses = poses[_distinct(poses, surface.size, ROUGHLY)[:REFINED]]
    tried, scores = refine(scan, surface, poses[:TRIED])
    return np.concatenate([tried, poses[TRIED:]]), float(scores[0])


def refine(
    scan: Scan, surface: Surface, poses: Float64[np.ndarray, "H 4 4"]
) -> tuple[Float64[np.ndarray, "R 4 4"], Float64[np.ndarray, " R"]]:
    """Each moved to where the points lie best on planes of the surface near them; those
    that come together once, best first, with how well the points lie on it: by one
    measure for all models, or large ones would come nearer."""
    small_gicp = require("small_gicp", "cad")
    own = scan.raw.points[:: 1 + len(scan.raw) // REFINING] - scan.middle
    pair = surface.cloud[0], small_gicp.PointCloud(own), surface.cloud[1]
    still = {"rotation_epsilon": STILL, "translation_epsilon": STILL * surface.size}
    common = max(NEAR[-1] * scan.size, FITS * scan.noise)
    refined, scores = np.copy(poses), np.zeros(len(poses))
    for row in range(len(poses)):
        for near in NEAR:
            reach = max(near * surface.size, FITS * scan.noise)
            about = *pair, refined[row], "PLANE_ICP", reach
            refined[row] = small_gicp.align(*about, **still).T_target_source
        eye = refined[row, :3, :3] @ (scan.eye - scan.middle) + refined[row, :3, 3]
        front = surface.front(eye, FEWER)
        gap = _gaps(scan, front, refined[[row]], RANKED)[0]
        scores[row] = 1 - (np.minimum(np.abs(gap) / common, 1) ** 2).mean()
    rows = np.argsort(-scores, kind="stable")
    rows = rows[_distinct(refined[rows], surface.size, EXACTLY)]
    return refined[rows], scores[rows]


def settled(
    scan: Scan, surface: Surface, pose: Float64[np.ndarray, "4 4"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pose after its last steps, by the side that faces the sensor; the covariance of
    a turn about the middle and a shift; and how far all points lie before it."""
    front = surface.front(pose[:3, :3] @ (scan.eye - scan.middle) + pose[:3, 3])
    aside = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    poses = rigid(np.eye(3), ASIDE * surface.size * aside) @ pose
    # What no point tells, as where along a plane it lies, is known to about `LOOSE`.
    loose = np.diag((LOOSE * np.repeat([1.0, surface.size], 3)) ** -2)
    for every, steps in SETTLED:
        for near in steps:
            gap, laid, rows = _gaps(scan, front, poses, every)
            reach = max(near * surface.size, FITS * scan.noise)
            weights = every * np.maximum(1 - (gap / reach) ** 2, 0) / scan.noise**2
            normals = front.normals[rows].astype(np.float64)
            slopes = np.concatenate([np.cross(laid, normals), normals], axis=2)
            weighted = (weights[..., None] * slopes).swapaxes(1, 2)
            covariance = np.linalg.inv(weighted @ slopes + loose)
            offsets = np.einsum("hsi,hsi->hs", laid - front.points[rows], normals)
            motion = -(covariance @ weighted @ offsets[..., None])[..., 0]
            turns = Rotation.from_rotvec(motion[:, :3]).as_matrix()
            poses = rigid(turns, motion[:, 3:]) @ poses
        gap = _gaps(scan, front, poses, every)[0]
        reach = max(SETTLED[-1][1][-1] * surface.size, FITS * scan.noise)
        off = (np.minimum(np.abs(gap) / reach, 1) ** 2).mean(axis=1)
        off[1:] += AHEAD
        best = off.argmin()
        poses, covariance = poses[[best]], covariance[[best]]
    return poses[0], covariance[0], _gaps(scan, front, poses)[0][0]


def _gaps(
    scan: Scan, front: Front, poses: np.ndarray, every: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far one measured point in so many lies before the surface that faces the
    sensor in each pose, negative behind it; where it lies, and the row nearest."""
    points = scan.raw.points[::every] - scan.middle
    laid = points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    near, squares = front.tree.batch_knn_search(laid.reshape(-1, 3), NEIGHBORS)
    offset = laid.reshape(-1, 1, 3) - front.points[near]
    gap = np.einsum("ski,ski->sk", offset, front.normals[near])
    beside = squares - gap**2 > (FLAT * front.spacing) ** 2
    gap = np.where(beside, np.copysign(np.sqrt(squares), gap), gap)
    best = np.abs(gap).argmin(axis=1)[:, None]
    gap, rows = (np.take_along_axis(of, best, 1) for of in (gap, near))
    return gap.reshape(laid.shape[:2]), laid, rows.reshape(laid.shape[:2])


def rigid(
    rotations: Float[np.ndarray, "*#H 3 3"], shifts: Float[np.ndarray, "*H 3"]
) -> Float64[np.ndarray, "*H 4 4"]:
    """The matrices of turns followed by shifts; one turn may go with many."""
    motions = np.zeros((*shifts.shape[:-1], 4, 4))
    motions[..., :3, :3], motions[..., :3, 3], motions[..., 3, 3] = rotations, shifts, 1
    return motions


def _distinct(poses: np.ndarray, size: float, near: float) -> list[int]:
    """Rows of poses that bring some point farther than `near` sizes from all before."""
    corners = np.append(0.5 * size * np.eye(4, 3), np.ones((4, 1)), axis=1)
    laid = corners @ poses.swapaxes(1, 2)
    other = np.abs(laid[:, None] - laid).max(axis=(2, 3)) > near * size
    chosen: list[int] = []
    for row in range(len(other)):
        if other[row, chosen].all():
            chosen.append(row)
    return chosen


def by_pairs(scan: Scan, surface: Surface) -> Float64[np.ndarray, "H 4 4"]:
    """Poses that lay a pair of the scan's points on a like pair of the model's: those
    first that are like few of them."""
    rng = np.random.default_rng(0)
    points, normals = (scan.means - scan.middle)[scan.pairs], scan.normals[scan.pairs]
    codes = pair_codes(points, normals, surface.size)
    first = np.searchsorted(surface.codes, codes, "left")
    count = np.searchsorted(surface.codes, codes, "right") - first
    order = np.argsort(count, kind="stable")
    order = order[count[order] > 0]
    taken = np.minimum(count[order], PER_PAIR)
    rows = np.repeat(order, taken)[:HYPOTHESES]
    rank = (rng.random(len(rows)) * count[rows]).astype(int)
    like = surface.pairs[first[rows] + rank].astype(int)
    own = surface.points[like].astype(np.float64)
    frames = _frames(own, surface.normals[like[:, 0]].astype(np.float64))
    rotations = frames @ _frames(points[rows], normals[rows, 0]).swapaxes(1, 2)
    middles = np.einsum("hij,hj->hi", rotations, points[rows].mean(axis=1))
    return rigid(rotations, own.mean(axis=1) - middles)


def _frames(
    pairs: Float[np.ndarray, "P 2 3"], normals: Float[np.ndarray, "P 3"]
) -> Float64[np.ndarray, "P 3 3"]:
    """Axes, as columns, of the first point's normal and the line to the second."""
    aside = np.cross(normals, pairs[:, 1] - pairs[:, 0])
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
    return np.stack([normals, aside, np.cross(normals, aside)], axis=2)


def by_headings(
    scan: Scan, surface: Surface, up: Float[np.ndarray, "3"]
) -> Float64[np.ndarray, "H 4 4"]:
    """Upright poses at evenly spaced headings, the box of the scan in the middle of the
    model's or against either side."""
    lying = Rotation.align_vectors([(0.0, 0.0, 1.0)], [up])[0].as_matrix()
    angles = 2 * np.pi * np.arange(HEADINGS)[:, None] / HEADINGS
    box = surface.points.min(axis=0), surface.points.max(axis=0)
    poses = []
    for turn in Rotation.from_euler("z", angles).as_matrix() @ lying:
        turned = (scan.means - scan.middle) @ turn.T
        low, high = box[0] - turned.min(axis=0), box[1] - turned.max(axis=0)
        sides = np.stack([low, 0.5 * (low + high), high], axis=1)
        found = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
        poses.append(rigid(turn, found))
    return np.concatenate(poses)


def _scores(
    scan: Scan, surface: Surface, poses: np.ndarray, count: int
) -> Float[np.ndarray, " H"]:
    """How well so many points lie on the surface in each pose: 1 if all do, and 0 for
    those out of reach. In single precision."""
    rows = scan.some[:count]
    points = (scan.means[rows] - scan.middle).astype(np.float32)
    moved = poses.astype(np.float32).swapaxes(1, 2)
    turned = moved[:, :3, :3]
    laid = points @ turned + moved[:, 3:, :3]
    near = surface.index(laid)
    offset = laid - surface.points[near]
    reach = max(REACH * surface.size, FITS * scan.noise)
    apart = np.einsum("hsi,hsi->hs", offset, offset) / np.float32(reach**2)
    normals = scan.normals[rows].astype(np.float32) @ turned
    facing = np.einsum("hsi,hsi->hs", normals, surface.normals[near])
    facing = np.where(surface.two_sided[near], np.abs(facing), facing)
    return (np.maximum(1 - apart, 0) * (facing > AGREE)).mean(axis=1)
