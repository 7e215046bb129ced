"""Where a model lies in a scan: poses by pairs of points, the best of them refined."""

import itertools

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from prism_jax.io.errors import require
from prism_jax.registration.scan import Scan
from prism_jax.registration.surface import Surface, pair_codes

HYPOTHESES, PER_PAIR = 3000, 12  # poses by pairs, and at most of one pair of the scan
HEADINGS = 36
TOWARD = 0.3  # cosine over which a sensor sees a side of a box
JUDGED, KEPT = (32, 200), 150  # points that judge poses in turn, and what they keep
TRIED, REFINED = 3, 12  # poses of any model, and of those that are looked at closely
REACH = 0.06  # of a model's point, in longest sides, in the search
STRICTLY = 0.5  # of this reach, for what was refined
NEAR = 0.1, 0.03, 0.01  # in longest sides: what is refined, step by step
FITTING = 3.0  # in the noise of the sensor: no reach is less
AGREE = 0.4  # least cosine between the normals of what lies together
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
    tried = refine(scan, surface, poses[:TRIED])
    score = float(_scores(scan, surface, tried[:1], JUDGED[-1], STRICTLY)[0])
    return np.concatenate([tried, poses[TRIED:]]), score


def refine(
    scan: Scan, surface: Surface, poses: Float64[np.ndarray, "H 4 4"]
) -> Float64[np.ndarray, "R 4 4"]:
    """Each moved to where the points lie best on planes of the surface near them; those
    that come together once, best first."""
    small_gicp = require("small_gicp", "cad")
    cloud, tree = surface.cloud
    still = {"rotation_epsilon": STILL, "translation_epsilon": STILL * surface.size}
    refined = np.copy(poses)
    for row, near in itertools.product(range(len(poses)), NEAR):
        reach = max(near * surface.size, FITTING * scan.noise)
        own = cloud, scan.cloud, tree, refined[row], "PLANE_ICP", reach
        refined[row] = small_gicp.align(*own, **still).T_target_source
    scores = _scores(scan, surface, refined, JUDGED[-1], STRICTLY)
    refined = refined[np.argsort(-scores, kind="stable")]
    return refined[_distinct(refined, surface.size, EXACTLY)]


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
    model's or against either side; above or below against that which the sensor sees.
    """
    lying = Rotation.align_vectors([(0.0, 0.0, 1.0)], [up])[0].as_matrix()
    angles = 2 * np.pi * np.arange(HEADINGS)[:, None] / HEADINGS
    view = (scan.eye - scan.middle) / np.linalg.norm(scan.eye - scan.middle)
    box = surface.points.min(axis=0), surface.points.max(axis=0)
    poses = []
    for turn in Rotation.from_euler("z", angles).as_matrix() @ lying:
        turned = (scan.means - scan.middle) @ turn.T
        low, high = box[0] - turned.min(axis=0), box[1] - turned.max(axis=0)
        sides = []
        for lower, upper, toward in zip(low, high, turn @ view, strict=True):
            both = [lower, 0.5 * (lower + upper), upper]
            seen = len(sides) == 2 and abs(toward) > TOWARD
            sides.append([upper if toward > 0 else lower] if seen else both)
        found = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
        poses.append(rigid(turn, found))
    return np.concatenate(poses)


def _scores(
    scan: Scan, surface: Surface, poses: np.ndarray, count: int, strict: float = 1.0
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
    reach = strict * max(REACH * surface.size, FITTING * scan.noise)
    apart = np.einsum("hsi,hsi->hs", offset, offset) / np.float32(reach**2)
    normals = scan.normals[rows].astype(np.float32) @ turned
    facing = np.einsum("hsi,hsi->hs", normals, surface.normals[near])
    facing = np.where(surface.two_sided[near], np.abs(facing), facing)
    return (np.maximum(1 - apart, 0) * (facing > AGREE)).mean(axis=1)
