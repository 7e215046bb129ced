"""What speaks for or against a completion without the truth being known."""

import numpy as np
from jaxtyping import Array, Float

from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.preprocessing.observation import Observation
from prism_jax.preprocessing.visibility import PAST, looked_through

SAMPLE = 1024  # measured points that are asked, evenly spaced rows of a larger cloud

PLANE_NEIGHBORS = 12  # of a point and itself, that a plane is laid through

LOOKS = 3
"""A verdict compares what a frame is completed to in so many poses, the first of
`prism_jax.models.poses`: as it is, mirrored, and by a quarter turn."""

Looks = list[IndexedCloud]
"""What a frame is completed to in each of several poses."""


def pose_predictions(
    before: Float[Array | np.ndarray, "P 3"], poses: int
) -> Looks | None:
    """What the network as it was makes of each of the first `LOOKS` poses, from all of
    them, one behind the other; None if they are fewer."""
    clouds = np.split(np.asarray(before), poses)[:LOOKS]
    return [IndexedCloud(cloud) for cloud in clouds] if poses >= LOOKS else None


def evidence_of(
    seen: Observation,
    read: Observation,
    prediction: IndexedCloud | Float[np.ndarray, "P 3"],
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
    measured, partial, prediction = seen.cloud, read.cloud, IndexedCloud.of(prediction)
    spacing = partial.spacing
    eye = np.asarray(seen.eye, np.float64)
    through = looked_through(prediction.points, partial, eye, PAST * spacing)
    return {
        "num_points": float(len(measured.distinct)),
        "spacing": float(min(spacing, 1.0)),
        "roughness": roughness(measured),
        "strays": outliers,
        "in_front": in_front,
        "looked_through": float(through.mean()),
        "unexplained": float(prediction.distance(asked(measured)).mean()),
        "reach": float(measured.distance(prediction.points).mean()),
        "disagreement_mirrored": _disagreement(looks[0], looks[1]),
        "disagreement_turned": _disagreement(looks[0], looks[2]),
        "novelty": novelty,
    }


def asked(cloud: IndexedCloud) -> Float[np.ndarray, "M 3"]:
    """`SAMPLE` of a larger cloud's distinct points, or fewer; evenly spaced rows."""
    return cloud.distinct.points[:: -(-len(cloud.distinct) // SAMPLE)]


def roughness(cloud: IndexedCloud) -> float:
    """Usual distance of a cloud's points from the planes through their neighbours. Of
    too few neighbours it is 0."""
    if len(cloud.distinct) <= PLANE_NEIGHBORS:
        return 0.0
    tree = cloud.distinct.tree
    near = tree.data[np.asarray(tree.query(asked(cloud), k=PLANE_NEIGHBORS)[1])]
    offsets = near - near.mean(axis=1, keepdims=True)
    squares = np.einsum("nki,nkj->nij", offsets, offsets) / PLANE_NEIGHBORS
    thickness = np.linalg.eigvalsh(squares)[:, 0]
    return float(np.sqrt(np.median(np.maximum(thickness, 0.0))))


def _disagreement(first: IndexedCloud, other: IndexedCloud) -> float:
    """CD-L1 of two looks."""
    there, back = other.distance(first.points), first.distance(other.points)
    return float(0.5 * (there.mean() + back.mean()))
