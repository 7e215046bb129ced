"""How well a model in a pose explains a scan: its points, and what is not there."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import KDTree

from prism_jax.geometry.camera import MIN_DEPTH
from prism_jax.geometry.visibility import SURFACE, UNKNOWN, look_up
from prism_jax.registration.pose import Poses, solve_planes
from prism_jax.registration.scan import Scan
from prism_jax.registration.surface import Surface, foremost

FITS = 3.0  # in the sensor's noise: nearer points lie on the model
NEAR = 0.03, 0.02, 0.015, 0.01  # in longest sides: what is refined, step by step
FEWER = 3  # one point in so many refines all steps but the last
NEIGHBORS = 4  # points of the surface, of which one explains a measured point
FLAT = 2.5  # in spacings of the surface: so far its points stand for their planes
EVERY = 2  # one of its points in so many tells what is seen of it
EXACT = 0.0015  # in longest sides: so far points and poses are exact
GRAZING = 0.2  # cosine under which nothing is expected of a surface
TOLERANCE = 0.03  # in longest sides: so much nearer to the sensor is in front

LEAST_FIT, LEAST_CLOSE, LEAST_SEEN, LEAST_COVERED = 0.925, 0.62, 0.25, 0.015
MOST_DENIED, MOST_STRAIN, MOST_BIAS, AMPLE, MARGIN = 0.05, 1.45, 2.5, 0.5, 0.5
"""What a model needs to be taken for an object, chosen on validation parts."""


class Evidence(NamedTuple):
    """What speaks for a model, without knowing the truth."""

    fit: float  # share of the measured points within `FITS` deviations of the model
    close: float  # share of these within one
    seen: float  # share of the front that should have been seen, what was
    denied: float  # and what the sensor looked through
    covered: float  # share of all of the model's surface, what was measured
    strain: float  # of the points, as `strain` has it
    bias: float  # of the means of neighbours, in what noise alone would make of them


class Match(NamedTuple):
    """A model in its pose."""

    pose: Float64[np.ndarray, "4 4"]  # from the model's frame to the scan's
    # Of turns about the middle of the scan and of shifts, along the scan's axes.
    covariance: Float64[np.ndarray, "6 6"]
    middle: Float64[np.ndarray, "3"]
    noise: float  # the sensor's
    evidence: Evidence

    @property
    def score(self) -> float:
        """1 for a model that explains everything."""
        return self.evidence.fit * self.evidence.seen

    def placed(
        self, surface: Surface
    ) -> tuple[Float64[np.ndarray, "M 3"], Float64[np.ndarray, " M"]]:
        """The surface's points where they lie in the scan, and the distance by which
        each is expected to miss what the sensor measures there."""
        rotation, shift = self.pose[:3, :3], self.pose[:3, 3]
        points = surface.points @ rotation.T + shift
        normals = surface.normals @ rotation.T
        slopes = np.concatenate([np.cross(points - self.middle, normals), normals], 1)
        variance = np.einsum("ni,ij,nj->n", slopes, self.covariance, slopes)
        return points, np.sqrt(2 / np.pi * (variance + self.noise**2))


def match(
    scan: Scan,
    surface: Surface,
    tree: KDTree,
    rotation: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, "3"],
) -> Match:
    """A pose of the search refined by the points as they were measured, and what speaks
    for it. `tree` is that of the surface's points."""
    middle = scan.raw.mean(axis=0)
    points, eye = scan.raw - middle, scan.eye - middle
    poses = Poses(rotation[None], (shift + rotation @ middle)[None])
    squares = np.zeros((6, 6))
    for number, near in enumerate(NEAR):
        some = points if number + 1 == len(NEAR) else points[::FEWER]
        gap, laid, rows = _gaps(some, eye, surface, tree, poses)
        reach = max(near * surface.size, FITS * scan.noise)
        weights = np.maximum(1 - (gap / reach) ** 2, 0)
        on = (surface.points[rows] - poses.shifts)[None]
        normals = surface.normals[None, rows].astype(np.float64)
        own = (laid - poses.shifts)[None], on, normals, weights[None]
        motion, (squares,) = solve_planes(*own)
        turned = poses._replace(shifts=np.zeros((1, 3))).moved(motion)
        poses = turned._replace(shifts=poses.shifts + turned.shifts)
    gap, _, _ = _gaps(points, eye, surface, tree, poses)
    apart = np.abs(gap)
    pose, back = np.eye(4), poses.rotations[0].T
    pose[:3, :3], pose[:3, 3] = back, middle - back @ poses.shifts[0]
    axes = np.kron(np.eye(2), back)
    inverse = np.linalg.pinv(squares, hermitian=True)
    covariance = scan.noise**2 * axes @ inverse @ axes.T
    fits = apart <= FITS * scan.noise
    close = float((apart[fits] <= scan.noise).mean()) if fits.any() else 0.0
    badly = strain(apart, scan.noise), _bias(scan, gap, fits, surface.size)
    told = Evidence(
        float(fits.mean()), close, *_looked_for(scan, surface, pose), *badly
    )
    return Match(pose, covariance, middle, scan.noise, told)


def _gaps(
    points: np.ndarray, eye: np.ndarray, surface: Surface, tree: KDTree, poses: Poses
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far points lie before the surface that faces the sensor, negative behind it,
    in one pose; where they lie, and the rows of the surface that are nearest."""
    laid, seen_from = (
        p @ poses.rotations[0].T + poses.shifts[0] for p in (points, eye)
    )
    away, near = tree.query(laid, k=NEIGHBORS)
    offset, normals = laid[:, None] - surface.points[near], surface.normals[near]
    gap = np.einsum("ski,ski->sk", offset, normals)
    toward = np.einsum("si,ski->sk", seen_from - laid, normals) > 0
    beside = away**2 - gap**2 > (FLAT * surface.spacing) ** 2
    gap = np.where(toward, 1, -1) * np.where(beside, np.copysign(away, gap), gap)
    gap[~(toward | surface.two_sided[near])] = np.inf
    best = np.abs(gap).argmin(axis=1)[:, None]
    gap, rows = (np.take_along_axis(of, best, 1)[:, 0] for of in (gap, near))
    return gap, laid, rows


def _bias(scan: Scan, gap: np.ndarray, fits: np.ndarray, size: float) -> float:
    """The square of how far neighbours lie from the model on average, in what noise
    alone makes of it: about 1 for the right model, more where the shape is another."""
    if not fits.any():
        return FITS**2
    owner, gap = scan.cells[fits], gap[fits]
    count = np.bincount(owner)
    total = np.bincount(owner, gap)[count > 0]
    count = count[count > 0]
    usual = count * scan.noise**2 + (count * EXACT * size) ** 2
    return float(np.minimum(total**2 / usual, FITS**2).mean())


def _looked_for(
    scan: Scan, surface: Surface, pose: np.ndarray
) -> tuple[float, float, float]:
    """Of the model's front the shares that the sensor measured and that it looked
    through, and the measured share of all of it. What hides it counts for nothing, and
    what is not known for half. All was seen where nobody knows where a sensor stood."""
    if scan.visibility is None:
        return 1.0, 0.0, 1.0
    rotation, shift = pose[:3, :3], pose[:3, 3]
    points = surface.points[::EVERY] @ rotation.T + shift
    normals = surface.normals[::EVERY] @ rotation.T
    rays = scan.eye - points
    away = np.linalg.norm(rays, axis=1)
    facing = np.einsum("ij,ij->i", normals, rays) / away
    facing = np.where(surface.two_sided[::EVERY], np.abs(facing), facing)
    seen_from = np.asarray(scan.visibility.camera.to_camera(points))
    depth = seen_from[:, 2]
    expected = (facing > GRAZING) & (depth > MIN_DEPTH)
    image = away.mean() * seen_from[:, :2] / np.maximum(depth, MIN_DEPTH)[:, None]
    spacing = surface.spacing * np.sqrt(EVERY)
    image = np.clip(image, -1e3 * spacing, 1e3 * spacing)
    points = points[expected & foremost(image, away, spacing)]
    reach = max(TOLERANCE * surface.size, FITS * scan.noise)
    state, behind = look_up(scan.visibility, points)
    measured = (state == SURFACE) & (np.abs(behind) <= reach)
    free = scan.visibility._replace(depth=scan.free)
    denied = (np.asarray(look_up(free, points)[1]) < -reach) & ~measured
    unknown = 0.5 * (state == UNKNOWN).sum()
    counted = max(measured.sum() + denied.sum() + unknown, 1)
    covered = EVERY * measured.sum() / len(surface.points)
    shares = measured.sum() / counted, denied.sum() / counted
    return float(shares[0]), float(shares[1]), float(covered)


def strain(apart: Float[np.ndarray, " N"], noise: float) -> float:
    """How badly an explanation that lies so far from measured points explains them: 1
    if by as much as the sensor's noise, and `FITS` squared at most."""
    return float((np.minimum(apart / noise, FITS) ** 2).mean())


def doubt(told: Evidence, other: float = np.inf) -> str | None:
    """What speaks most against a model, if anything does; `other` is the strain of
    another explanation."""
    if told.fit < LEAST_FIT:
        return f"it explains {told.fit:.0%} of the points"
    if told.close < LEAST_CLOSE:
        return f"only {told.close:.0%} of these points are as near as the noise"
    if told.denied > MOST_DENIED:
        return f"the sensor saw through {told.denied:.0%} of its front"
    if told.seen < LEAST_SEEN or told.covered < LEAST_COVERED:
        return f"{told.seen:.0%} of its front was measured"
    # The less of it was seen, the better must it fit.
    share = min(1.0, told.seen / AMPLE)
    if told.strain > share * MOST_STRAIN or told.bias > share * MOST_BIAS:
        return "its shape differs by more than the noise"
    # A network's points keep to those that it was given, whatever these are of.
    if told.strain > other + MARGIN:
        return "the network explains the points better"
    return None
