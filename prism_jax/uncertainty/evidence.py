"""What speaks for or against a completion without the truth being known."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import KDTree

from prism_jax.geometry.spacing import median_spacing
from prism_jax.preprocessing.observation import Observation
from prism_jax.preprocessing.visibility import PAST, looked_through

SAMPLE = 1024  # measured points that are asked, evenly spaced rows of a larger cloud

PLANE_NEIGHBORS = 12  # of a measured point, that a plane is laid through

LOOKS = 3
"""A verdict compares what a frame is completed to in so many poses, the first of
`prism_jax.models.poses`: as it is, mirrored, and by a quarter turn."""

Looks = Sequence[Float[Array | np.ndarray, "L 3"]]


def pose_predictions(
    before: Float[Array | np.ndarray, "P 3"], poses: int
) -> list[np.ndarray] | None:
    """What the network as it was makes of each of the first `LOOKS` poses, from all of
    them, one behind the other; None if they are fewer."""
    return np.split(np.asarray(before), poses)[:LOOKS] if poses >= LOOKS else None


def evidence_of(
    seen: Observation,
    read: Observation,
    prediction: Float[np.ndarray, "P 3"],
    outliers: float,
    in_front: float,
    looks: Looks,
    novelty: float,
) -> dict[str, float]:
    """The numbers that `prism_jax.uncertainty.confidence.Calibration` turns into a
    verdict, by name.

    `seen` and `read` are what was observed and what the network read of it,
    `prediction` its output, adapted or not; `outliers` and `in_front` are shares of it,
    of what lies alone or outside, and of what hides measured points. `looks` is what it
    was in each pose before it adapted. `novelty` is how far the frame's
    features are from those of the training. Lengths are in half sides of the workspace.
    None is asked of an empty prediction.
    """
    measured = np.asarray(seen.partial, np.float64)[np.asarray(seen.inside)]
    distinct = np.unique(measured, axis=0)
    partial = np.asarray(read.partial, np.float64)
    some = asked(distinct)
    eye = np.asarray(seen.eye, np.float64)
    spacing = median_spacing(partial)
    away = KDTree(distinct).query(prediction)[0]
    through = looked_through(prediction, partial, eye, PAST * spacing)
    return {
        "num_points": float(len(distinct)),
        "spacing": float(min(spacing, 1.0)),
        "roughness": roughness(distinct, some),
        "strays": outliers,
        "in_front": in_front,
        "looked_through": float(through.mean()),
        "unexplained": float(KDTree(prediction).query(some)[0].mean()),
        "reach": float(away.mean()),
        "disagreement_mirrored": _apart(looks[0], looks[1]),
        "disagreement_turned": _apart(looks[0], looks[2]),
        "novelty": novelty,
    }


def asked(cloud: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    """`SAMPLE` of a larger cloud, or fewer; evenly spaced rows."""
    return cloud[:: -(-len(cloud) // SAMPLE)]


def roughness(cloud: Float[np.ndarray, "N 3"], some: Float[np.ndarray, "M 3"]) -> float:
    """Usual distance of some of a cloud's points from the planes through their
    neighbours. Of too few neighbours it is 0."""
    if len(cloud) <= PLANE_NEIGHBORS:
        return 0.0
    near = cloud[np.asarray(KDTree(cloud).query(some, k=PLANE_NEIGHBORS)[1])]
    offsets = near - near.mean(axis=1, keepdims=True)
    squares = np.einsum("nki,nkj->nij", offsets, offsets) / PLANE_NEIGHBORS
    thickness = np.linalg.eigvalsh(squares)[:, 0]
    return float(np.sqrt(np.median(np.maximum(thickness, 0.0))))


def _apart(first: Array | np.ndarray, second: Array | np.ndarray) -> float:
    """CD-L1 of two completions."""
    one, other = (np.asarray(cloud, np.float64) for cloud in (first, second))
    there = KDTree(other).query(one)[0].mean()
    return float(0.5 * (there + KDTree(one).query(other)[0].mean()))
