"""How well a model in a pose explains a scan: its points, and what is not there."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from prism_jax.geometry.camera import MIN_DEPTH
from prism_jax.geometry.visibility import BACKGROUND, SURFACE, UNKNOWN, look_up
from prism_jax.preprocessing.segmentation.clusters import thin
from prism_jax.preprocessing.visibility_map import in_free_space
from prism_jax.registration.pose import FITS, rigid, settled
from prism_jax.registration.scan import COARSE_CELLS, Scan
from prism_jax.registration.surface import FEW, FEWER, Surface, foremost

SOME = 4  # points of a cell that say something
GRAZING = 0.2  # cosine under which nothing is expected of a surface
BESIDE, APART = 0.04, 3.0
"""In longest sides and in spacings of a scan: nearer to it a surface was measured."""
TOLERANCE = 0.03  # in longest sides: so much nearer to the sensor is in front

LIMITS = {
    "fit": (0.9, np.inf, "it explains {:.1%} of the points"),
    "denied": (0.0, 0.01, "the sensor saw through {:.1%} of its front"),
    "covered": (0.3, np.inf, "{:.0%} of its surface was measured"),
    "odd": (0.0, 0.015, "something else is at {:.1%} of its places"),
    "seen": (0.35, np.inf, "{:.0%} of its front was measured"),
    "strain": (0.0, 2.2, "its shape differs by more than the noise"),
    "play": (0.0, 0.007, "what was measured does not tell its pose"),
}
"""Of the evidence for a model that is taken for an object, the least and the most, and
what speaks against it beyond them. Chosen on validation parts."""


class Evidence(NamedTuple):
    """What speaks for a model, without knowing the truth."""

    fit: float  # share of the measured points within `FITS` deviations of the model
    covered: float  # share of the model's surface within `BESIDE` of measured points
    seen: float  # share of the front that should have been seen, what was
    denied: float  # and what the sensor looked through
    odd: float  # share of places where most points, or most of the front, are denied
    strain: float  # the square of how far points lie off it, in noise, `FITS` at most
    play: float  # by which its surface may lie elsewhere, in longest sides


class Match(NamedTuple):
    """A model in its pose."""

    pose: Float64[np.ndarray, "4 4"]  # from the model's frame to the scan's
    # Of a turn about the middle of the model and a shift, along the model's axes.
    covariance: Float64[np.ndarray, "6 6"]
    noise: float  # the sensor's
    evidence: Evidence

    @property
    def score(self) -> float:
        """1 for a model that explains everything."""
        told = self.evidence
        return told.fit * told.seen * (1 - told.denied) * (1 - told.odd)

    def poses(self, scan: Scan, surface: Surface) -> Float64[np.ndarray, "1 4 4"]:
        """The pose as the search has it in a scan."""
        back = self.pose[:3, :3].T
        shift = back @ (scan.middle - self.pose[:3, 3]) - surface.middle
        return rigid(back, shift)[None]

    def placed(
        self, surface: Surface
    ) -> tuple[Float64[np.ndarray, "M 3"], Float64[np.ndarray, " M"]]:
        """The surface's points where they lie in the scan, and the distance by which
        each is expected to miss what the sensor measures there."""
        points = (surface.points[:FEW] + surface.middle) @ self.pose[:3, :3].T
        sigma = np.sqrt(2 / np.pi * (_play(surface, self.covariance) + self.noise**2))
        return points + self.pose[:3, 3], sigma


def match(scan: Scan, surface: Surface, pose: Float[np.ndarray, "4 4"]) -> Match:
    """A pose of the search once it is settled, and what speaks for it."""
    pose, covariance, gap = settled(scan, surface, pose)
    back, shift = pose[:3, :3], pose[:3, 3]
    pose = rigid(back.T, scan.middle - back.T @ (shift + surface.middle))
    fits = np.abs(gap) <= FITS * scan.noise
    strain = float((np.minimum(np.abs(gap) / scan.noise, FITS) ** 2).mean())
    placed = (surface.points[:FEWER] + surface.middle) @ back + pose[:3, 3]
    beside = max(BESIDE * surface.size, APART * scan.raw.spacing)
    away = scan.raw.tree.query(placed, distance_upper_bound=beside)[0]
    covered = float((away < beside).mean())
    seen, denied, odd = _looked_for(scan, surface, pose, placed)
    odd = max(odd, _odd(scan.cells, ~fits))
    play = float(np.sqrt(_play(surface, covariance).mean()) / surface.size)
    told = float(fits.mean()), covered, seen, denied, odd, strain, play
    return Match(pose, covariance, scan.noise, Evidence(*told))


def _play(surface: Surface, covariance: np.ndarray) -> np.ndarray:
    """Variance of the places of few of its points, along their normals."""
    normals = surface.normals[:FEW]
    slopes = np.append(np.cross(surface.points[:FEW], normals), normals, axis=1)
    return np.einsum("ni,ij,nj->n", slopes, covariance, slopes)


def _odd(owner: np.ndarray, wrong: np.ndarray) -> float:
    """The share of cells with some points in which most points are wrong."""
    count, most = np.bincount(owner), 2 * np.bincount(owner, wrong)
    return float((most > count)[count >= SOME].mean()) if (count >= SOME).any() else 0.0


def _looked_for(
    scan: Scan, surface: Surface, pose: np.ndarray, points: np.ndarray
) -> tuple[float, float, float]:
    """Of the model's front the shares that the sensor measured and looked through, and
    the share of its places that it looked through mostly. What hides it does not count,
    the unknown by half. All was seen where nobody knows where a sensor stood."""
    if scan.visibility is None:
        return 1.0, 0.0, 0.0
    normals = surface.normals[:FEWER] @ pose[:3, :3].T
    rays = scan.eye - points
    away = np.linalg.norm(rays, axis=1)
    facing = np.einsum("ij,ij->i", normals, rays) / away
    facing = np.where(surface.two_sided[:FEWER], np.abs(facing), facing)
    seen_from = np.asarray(scan.visibility.camera.to_camera(points))
    depth = seen_from[:, 2]
    expected = (facing > GRAZING) & (depth > MIN_DEPTH)
    image = away.mean() * seen_from[:, :2] / np.maximum(depth, MIN_DEPTH)[:, None]
    spacing = float(np.sqrt(surface.area / len(points)))
    image = np.clip(image, -1e3 * spacing, 1e3 * spacing)
    points = points[expected & foremost(image, away, spacing)]
    reach = max(TOLERANCE * surface.size, FITS * scan.noise)
    state, behind = map(np.asarray, look_up(scan.visibility, points))
    measured = (state == SURFACE) & (np.abs(behind) <= reach)
    # What was measured of the object itself may lie behind such a front, too.
    known = np.where(np.asarray(scan.visibility.state) == UNKNOWN, UNKNOWN, BACKGROUND)
    beyond = scan.visibility._replace(state=known.astype(np.uint8))
    focal = scan.visibility.camera.intrinsics[0, 0] / away.mean()
    about = 1 + int(2 * scan.raw.spacing * focal)
    denied = in_free_space(points, beyond, reach, about) & ~measured
    unknown = 0.5 * (state == UNKNOWN).sum()
    counted = max(measured.sum() + denied.sum() + unknown, 1)
    odd = _odd(thin(points, COARSE_CELLS)[1], denied)
    return float(measured.sum() / counted), float(denied.sum() / counted), odd


def doubt(told: Evidence) -> str | None:
    """What speaks most against a model, if anything does."""
    for name, (least, most, reason) in LIMITS.items():
        if not least <= (value := getattr(told, name)) <= most:
            return reason.format(value)
    return None
