"""Where a model lies in a scan: poses by pairs of points, the best of them refined."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from prism_jax.registration.scan import Scan
from prism_jax.registration.surface import Surface, pair_codes

HYPOTHESES, PER_PAIR = 3000, 12  # poses by pairs, and at most of one pair of the scan
HEADINGS = 36
TOWARD = 0.3  # cosine over which a sensor sees a side of a box
# How many poses are kept, by how many points they are judged, and the reaches of the
# steps by which they are refined then, in `REACH`.
ROUNDS = (
    (300, 32, ()),
    (48, 200, (2.0, 1.5, 1.0)),
    (48, 200, (0.7, 0.5, 0.4)),
    (6, 200, ()),
)
STEPPED = 64  # points that refine
REACH = 0.06  # of a model's point, in longest sides, in the search
FITTING = 3.0  # in the noise of the sensor: no reach is less
AGREE = 0.4  # least cosine between the normals of what lies together


class Poses(NamedTuple):
    """From the scan's frame to the model's."""

    rotations: Float[np.ndarray, "H 3 3"]
    shifts: Float[np.ndarray, "H 3"]

    def of(self, rows: list[int] | np.ndarray) -> "Poses":
        """Some of them."""
        return Poses(self.rotations[rows], self.shifts[rows])

    def moved(self, motions: Float[np.ndarray, "H 6"]) -> "Poses":
        """Each followed by a turn about the origin, a vector, and a shift."""
        turn = Rotation.from_rotvec(motions[:, :3]).as_matrix()
        shifts = np.einsum("hij,hj->hi", turn, self.shifts) + motions[:, 3:]
        return Poses(turn @ self.rotations, shifts)


def search(
    scan: Scan, surface: Surface, up: Float[np.ndarray, "3"]
) -> tuple[Poses, Float[np.ndarray, " H"]]:
    """The likeliest poses of a model in a scan, good to about its noise, best first,
    and how well the points lie on the model in each: 1 if all do. The model may stand
    upright, its z along `up` in the scan's frame, or lie anyhow."""
    middle = scan.means.mean(axis=0)  # poses turn about it
    points = (scan.means - middle)[scan.some].astype(np.float32)
    normals = scan.normals[scan.some].astype(np.float32)
    found = by_pairs(scan, surface, middle), by_headings(scan, surface, middle, up)
    poses = Poses(*map(np.concatenate, zip(*found, strict=True)))
    reach, scores = REACH * surface.size, np.zeros(0)
    for number, (kept, asked, steps) in enumerate(ROUNDS):
        own = points[:asked], normals[:asked], surface
        # What was refined is judged more strictly.
        strict = max(reach, FITTING * scan.noise) / (1 if number < 2 else 2)
        scores = _weights(*own, poses, strict)[0].mean(axis=1)
        order = np.argsort(-scores, kind="stable")[:kept]
        poses, scores = poses.of(order), scores[order]
        few = points[:STEPPED], normals[:STEPPED], surface
        for step in steps:
            near = max(step * reach, FITTING * scan.noise)
            weights, laid, rows = _weights(*few, poses, near)
            on = surface.points[rows], surface.normals[rows]
            poses = poses.moved(solve_planes(laid, *on, weights)[0])
    shifts = poses.shifts - np.einsum("hij,j->hi", poses.rotations, middle)
    return poses._replace(shifts=shifts), scores


def by_pairs(scan: Scan, surface: Surface, middle: Float[np.ndarray, "3"]) -> Poses:
    """Poses that lay a pair of the scan's points on a like pair of the model's: those
    first that are like few of them."""
    rng = np.random.default_rng(0)
    points, normals = (scan.means - middle)[scan.pairs], scan.normals[scan.pairs]
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
    return Poses(rotations, own.mean(axis=1) - middles)


def _frames(
    pairs: Float[np.ndarray, "P 2 3"], normals: Float[np.ndarray, "P 3"]
) -> Float64[np.ndarray, "P 3 3"]:
    """Axes, as columns, of the first point's normal and the line to the second."""
    aside = np.cross(normals, pairs[:, 1] - pairs[:, 0])
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
    return np.stack([normals, aside, np.cross(normals, aside)], axis=2)


def by_headings(
    scan: Scan, surface: Surface, middle: np.ndarray, up: Float[np.ndarray, "3"]
) -> Poses:
    """Upright poses at evenly spaced headings, the box of the scan in the middle of the
    model's or against either side; above or below against that which the sensor sees.
    """
    lying = Rotation.align_vectors([(0.0, 0.0, 1.0)], [up])[0].as_matrix()
    angles = 2 * np.pi * np.arange(HEADINGS)[:, None] / HEADINGS
    view = (scan.eye - middle) / np.linalg.norm(scan.eye - middle)
    box = surface.points.min(axis=0), surface.points.max(axis=0)
    rotations, shifts = [], []
    for turn in Rotation.from_euler("z", angles).as_matrix() @ lying:
        turned = (scan.means - middle) @ turn.T
        low, high = box[0] - turned.min(axis=0), box[1] - turned.max(axis=0)
        sides = []
        for lower, upper, toward in zip(low, high, turn @ view, strict=True):
            both = [lower, 0.5 * (lower + upper), upper]
            seen = len(sides) == 2 and abs(toward) > TOWARD
            sides.append([upper if toward > 0 else lower] if seen else both)
        found = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
        shifts.append(found)
        rotations.append(np.broadcast_to(turn, (len(found), 3, 3)))
    return Poses(np.concatenate(rotations), np.concatenate(shifts))


def _weights(
    points: np.ndarray,
    normals: np.ndarray,
    surface: Surface,
    poses: Poses,
    reach: float,
) -> tuple[np.ndarray, ...]:
    """How well each point lies on the surface in each pose, 1 to 0 at `reach`; where it
    lies, and the row of the surface near it. In single precision."""
    turned = poses.rotations.astype(np.float32).swapaxes(1, 2)
    laid = points @ turned + poses.shifts[:, None].astype(np.float32)
    rows = surface.index(laid)
    offset = laid - surface.points[rows]
    apart = np.einsum("hsi,hsi->hs", offset, offset) / np.float32(reach**2)
    facing = np.einsum("hsi,hsi->hs", normals @ turned, surface.normals[rows])
    facing = np.where(surface.two_sided[rows], np.abs(facing), facing)
    return np.maximum(1 - apart, 0) * (facing > AGREE), laid, rows


def solve_planes(
    laid: Float[np.ndarray, "H S 3"],
    on: Float[np.ndarray, "H S 3"],
    normals: Float[np.ndarray, "H S 3"],
    weights: Float[np.ndarray, "H S"],
) -> tuple[Float64[np.ndarray, "H 6"], Float64[np.ndarray, "H 6 6"]]:
    """The small turns about the origin and shifts that bring weighted points nearest to
    planes through others, and the matrices of the squares."""
    gap = np.einsum("hsi,hsi->hs", laid - on, normals)
    slopes = np.concatenate([np.cross(laid, normals), normals], axis=-1)
    weighted = slopes * weights[..., None]
    squares = (weighted.swapaxes(1, 2) @ slopes).astype(np.float64)
    pulled = -np.einsum("hsi,hs->hi", weighted, gap).astype(np.float64)
    least = 1e-4 * np.einsum("hii->hi", squares)[..., None] * np.eye(6)
    motions = np.linalg.solve(squares + least + 1e-12 * np.eye(6), pulled[..., None])
    return motions[..., 0], squares
