"""What speaks for or against a completion without the truth being known."""

import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import KDTree

from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.preprocessing.observation import Observation
from prism_jax.preprocessing.visibility import PAST, looked_through

SAMPLE = 1024  # measured points that are asked, evenly spaced rows of a larger cloud

PLANE_NEIGHBORS = 12  # of a measured point, that a plane is laid through

LOOKS = 3
"""A verdict compares what a frame is completed to in so many poses, the first of
`prism_jax.models.poses`: as it is, mirrored, and by a quarter turn."""

APART = 1e6  # half sides of the workspace between the looks in their tree


class Looks:
    """What a frame is completed to in each of several poses, in one tree."""

    def __init__(self, clouds: Sequence[Float[Array | np.ndarray, "L 3"]]):
        self.clouds = [np.asarray(cloud, np.float64) for cloud in clouds]

    @functools.cached_property
    def _tree(self) -> KDTree:
        """A fourth coordinate keeps the looks apart."""
        rows = [_labelled(cloud, look) for look, cloud in enumerate(self.clouds)]
        return KDTree(np.concatenate(rows))

    def distance(
        self, points: Float[np.ndarray, "Q 3"], look: int
    ) -> Float[np.ndarray, " Q"]:
        """From each point to the nearest of one look."""
        return self._tree.query(_labelled(points, look))[0]

    def disagreement(self, look: int) -> float:
        """CD-L1 of the first look and another."""
        first, other = self.clouds[0], self.clouds[look]
        there, back = self.distance(first, look), self.distance(other, 0)
        return float(0.5 * (there.mean() + back.mean()))


def pose_predictions(
    before: Float[Array | np.ndarray, "P 3"], poses: int
) -> Looks | None:
    """What the network as it was makes of each of the first `LOOKS` poses, from all of
    them, one behind the other; None if they are fewer."""
    return (
        Looks(np.split(np.asarray(before), poses)[:LOOKS]) if poses >= LOOKS else None
    )


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
        "disagreement_mirrored": looks.disagreement(1),
        "disagreement_turned": looks.disagreement(2),
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


def _labelled(points: Float[np.ndarray, "N 3"], look: int) -> Float[np.ndarray, "N 4"]:
    return np.column_stack([points, np.full(len(points), APART * look)])
