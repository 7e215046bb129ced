"""Completion metrics: one named convention each, in NumPy and float64.

A metric takes one pair of clouds in one unit of length and returns a float. An empty
cloud, a wrong shape or a coordinate that is not finite raises `ValueError`. Published
tables scale CD-L1 by 1e3 and CD-L2 by 1e3 or 1e4: nothing is scaled here.
"""

from typing import NamedTuple

import numpy as np
import scipy  # scipy.optimize, which takes long to import, at its first use
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

UNIT = "half the longest side of the complete cloud"
"""The unit of length of scores, unless a data set's published table has its own."""
F_SCORE_THRESHOLD = 0.01
UNSEEN, REACHES = 0.02, {"1": 0.01, "2": 0.02}
"""Of the longest side of the complete cloud: how far from every measured point truth is
unseen, and how near counts in `unseen_scores`, by the ends of the metrics' names."""
MAX_EXACT_POINTS = 4096

Cloud = Float[np.ndarray, "_ 3"]


class Scores(NamedTuple):
    """Every metric of one predicted cloud against one complete cloud."""

    # Sum, not halved, of the last two; as PoinTr and CRA-PCN report it on ShapeNet-55.
    cd_l2: float
    # Half the sum of the mean unsquared distances, both ways; as they report it on PCN.
    cd_l1: float
    f_score: float  # as the function
    emd: float | None  # as the function; None if not computed, which takes longest
    hausdorff: float  # the greatest nearest-neighbour distance of both ways
    # As `unseen_scores`, which needs the measured points; else None.
    precision_1: float | None = None
    recall_1: float | None = None
    f_1: float | None = None
    precision_2: float | None = None
    recall_2: float | None = None
    f_2: float | None = None

    def named(self) -> dict[str, float]:
        """The metrics that were computed, by name, as results hold them."""
        return {k: v for k, v in self._asdict().items() if v is not None}


def score(
    prediction: Cloud, target: Cloud, threshold: float = F_SCORE_THRESHOLD
) -> Scores:
    """What one pair of clouds tells, all but `emd`, with one search each way."""
    prediction, target = _checked("prediction", prediction), _checked("target", target)
    forward, _ = KDTree(target).query(prediction)
    backward, _ = KDTree(prediction).query(target)
    return from_distances(forward, backward, threshold)


def f_score(
    prediction: Cloud, target: Cloud, threshold: float = F_SCORE_THRESHOLD
) -> float:
    """Harmonic mean of precision and recall at an unsquared distance, strictly below;
    zero when both are zero. Source: Tatarchenko et al., "What Do Single-view 3D
    Reconstruction Networks Learn?", CVPR 2019."""
    return score(prediction, target, threshold).f_score


def from_distances(
    forward: Float[np.ndarray, " N"],
    backward: Float[np.ndarray, " M"],
    threshold: float = F_SCORE_THRESHOLD,
) -> Scores:
    """`score` of known distances: of the prediction's points to their nearest target
    points (`forward`), and the reverse."""
    precision, recall = np.mean(forward < threshold), np.mean(backward < threshold)
    return Scores(
        cd_l2=float(np.mean(forward**2) + np.mean(backward**2)),
        cd_l1=float(0.5 * (forward.mean() + backward.mean())),
        f_score=_harmonic(precision, recall),
        emd=None,
        hausdorff=float(max(forward.max(), backward.max())),
    )


def unseen_scores(
    added: Float[np.ndarray, " A"], unseen: Float[np.ndarray, " U"], side: float
) -> dict[str, float]:
    """Precision of the added points, recall of the unseen truth, and the F-score of
    both, at each of `REACHES`. `added` are distances of the added points to the truth,
    `unseen` of the unseen truth to the output, `side` is the truth's longest side.

    Nothing added has no precision and an F-score of 0, nothing unseen neither recall
    nor F-score.
    Sources: Knapitsch et al., "Tanks and Temples", SIGGRAPH 2017, and as `f_score`; but
    here a distance equal to the reach counts.
    """
    found = {}
    for end, share in REACHES.items():
        near = {"precision": added <= share * side, "recall": unseen <= share * side}
        known = {
            name: float(which.mean()) for name, which in near.items() if len(which)
        }
        if "recall" in known:
            known["f"] = _harmonic(known.get("precision", 0.0), known["recall"])
        found |= {f"{name}_{end}": value for name, value in known.items()}
    return found


def _harmonic(precision: float | np.floating, recall: float | np.floating) -> float:
    both = precision + recall
    return float(2 * precision * recall / both) if both > 0 else 0.0


def emd(prediction: Cloud, target: Cloud) -> float:
    """Mean unsquared distance of the best one-to-one assignment, exact. The clouds need
    equal counts of at most `MAX_EXACT_POINTS`, or ValueError. Memory is quadratic, time
    up to cubic."""
    cloud, goal = _checked("prediction", prediction), _checked("target", target)
    if len(cloud) != len(goal):
        counts = f"{len(cloud)} and {len(goal)}"
        raise ValueError(f"emd needs equal counts, not {counts}: resample one")
    if len(cloud) > MAX_EXACT_POINTS:
        fault = f"emd takes up to {MAX_EXACT_POINTS} points, not {len(cloud)}"
        raise ValueError(f"{fault}: use fewer")
    cost = cdist(cloud, goal)
    return float(cost[scipy.optimize.linear_sum_assignment(cost)].mean())


def _checked(name: str, cloud: np.ndarray) -> np.ndarray:
    """In float64; faults are named."""
    cloud = np.asarray(cloud, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"{name} must have shape (N, 3), not {cloud.shape}")
    if len(cloud) == 0:
        raise ValueError(f"{name} is empty")
    if not np.isfinite(cloud).all():
        raise ValueError(f"{name} has coordinates that are NaN or infinite")
    return cloud
