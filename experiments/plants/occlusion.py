"""Virtual occlusion: what of a measured cloud something that is not there would hide.

Clouds are in any frame, in one unit of length. NumPy, not differentiable.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from experiments.simulation.raycast import Scene
from experiments.simulation.surroundings import random_occluder
from experiments.simulation.truncation import random_cut
from prism_jax.data.crops import random_crop
from prism_jax.observation.visibility import NUM_RAYS, REACH
from prism_jax.selection import TOLERANCE, usual_spacing

HIDDEN_SHARES = (0.1, 0.75)
"""Of the points: the least and the most that are hidden."""

FEWEST = 32
"""Points that are left at the least, where there are as many to begin with."""

TURNS = (20.0, 100.0)
"""Degrees about the vertical between the sensor and a second one."""


class Occluded(NamedTuple):
    """A cloud of which a part is hidden.

    Attributes:
      kept: what the network gets.
      hidden: what it is to return.
      eye: where the sensor stands that sees what is kept; None if nobody knows.
    """

    kept: Float[np.ndarray, "K 3"]
    hidden: Float[np.ndarray, "H 3"]
    eye: Float[np.ndarray, "3"] | None


def occluded(
    points: Float[np.ndarray, "N 3"],
    eye: Float[np.ndarray, "3"] | None,
    rng: np.random.Generator,
) -> Occluded:
    """A measured cloud behind a virtual occluder, cut off, or seen from elsewhere.

    In one case of three each: something stands between the sensor and the points
    (`simulation.surroundings`); the image's edge, a half space or a box cuts
    them off (`experiments.simulation.truncation`); a second sensor looks from another
    side, and what its own view of the points hides is hidden. What is nearest to a
    random viewpoint goes (`prism_jax.data.crops`) where none of these hides a share of
    `HIDDEN_SHARES`, and where the eye is None. Fewer than four points raise ValueError.
    """
    if len(points) < 4:
        raise ValueError("too few points to hide some")
    ways = (_behind_something, _within_a_cut, _seen_from_elsewhere)
    order = rng.permutation(len(ways))
    for way in order if eye is not None else ():
        kept, place = ways[way](points, eye, rng)
        share = 1.0 - kept.mean()
        enough = kept.sum() >= min(FEWEST, len(points) // 2)
        if HIDDEN_SHARES[0] <= share <= HIDDEN_SHARES[1] and enough:
            return Occluded(points[kept], points[~kept], place)
    rest, _ = random_crop(points, rng)
    gone = KDTree(rest).query(points)[0] > 0
    return Occluded(points[~gone], points[gone], eye)


def seen_from(
    points: Float[np.ndarray, "N 3"], eye: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " N"]:
    """Which points of a cloud no other point of it hides from an eye.

    A point is hidden if, of the points about its line of sight, one is more than
    `TOLERANCE` spacings nearer to the eye.
    """
    rays = points - eye
    distance = np.maximum(np.linalg.norm(rays, axis=1), np.finfo(np.float64).tiny)
    spacing = usual_spacing(points)
    sight = rays / distance[:, None]
    _, rows = KDTree(sight).query(
        sight,
        k=NUM_RAYS,
        distance_upper_bound=REACH * spacing / np.median(distance),
    )
    nearest = np.append(distance, np.inf)[rows].min(axis=1)
    return distance - nearest <= TOLERANCE * spacing


def _behind_something(points, eye, rng):
    """Bars, boxes, a plate or a blob between sensor and points."""
    thing = random_occluder(eye, points, rng)
    kept = np.ones(len(points), bool)
    if thing is not None:
        hits = thing.cast(eye, points - eye)
        away = np.linalg.norm(points - eye, axis=1)[hits.ray]
        kept[hits.ray[hits.distances < away]] = False
    return kept, eye


def _within_a_cut(points, eye, rng):
    """The image's edge, a half space or a box around somebody's workspace."""
    box = trimesh.creation.box(bounds=[points.min(axis=0), points.max(axis=0)])
    return random_cut(Scene(box), eye, points, rng).holds(points), eye


def _seen_from_elsewhere(points, eye, rng):
    """A second sensor, as far from the middle as the first, turned about the vertical
    by `TURNS` to either side."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    angle = rng.choice([-1.0, 1.0]) * rng.uniform(*TURNS)
    turn = Rotation.from_euler("z", angle, degrees=True)
    other = middle + turn.apply(eye - middle)
    return seen_from(points, other), other
