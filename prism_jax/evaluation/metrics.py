"""Completion metrics: one named convention each, in NumPy and float64.

A metric takes one pair of clouds in one unit of length and returns a float. An empty
cloud, a wrong shape or a coordinate that is not finite raises `ValueError`. Published
tables scale CD-L1 by 1e3 and CD-L2 by 1e3 or 1e4: nothing is scaled here.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # scipy.optimize, which takes long to import, at its first use
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

UNIT = "half the longest side of the complete cloud"
"""The unit of length of scores, unless a data set's published table has its own."""
F_SCORE_THRESHOLD = 0.01
MAX_EXACT_POINTS = 4096
_FEWEST = 16  # fewer points than this are not worth an assignment of their own
_ROUNDS = 10
"""Of relaxing the prices of a whole assignment; more cost more than they save."""

Cloud = Float[np.ndarray, "_ 3"]


class Scores(NamedTuple):
    """Every metric of one predicted cloud against one complete cloud, as the functions
    of these names give them."""

    cd_l2: float  # the sum of the last two
    cd_l1: float
    f_score: float
    emd: float | None  # None if it was not computed, which takes the most time
    hausdorff: float
    prediction_to_truth: float  # mean squared distance; high where points stray
    truth_to_prediction: float  # the reverse; high where something is missing

    def named(self) -> dict[str, float]:
        """The metrics that were computed, by name, as results hold them."""
        return {k: v for k, v in self._asdict().items() if v is not None}


def score(
    prediction: Cloud, target: Cloud, threshold: float = F_SCORE_THRESHOLD
) -> Scores:
    """All metrics but `emd` of one pair of clouds, with one search each way."""
    prediction, target = _checked(prediction, target)
    forward, _ = KDTree(target).query(prediction)
    backward, _ = KDTree(prediction).query(target)
    return from_distances(forward, backward, threshold)


def cd_l1(prediction: Cloud, target: Cloud) -> float:
    """Half the sum of the two mean unsquared nearest-neighbour distances. As PoinTr and
    CRA-PCN report it on PCN."""
    return score(prediction, target).cd_l1


def cd_l2(prediction: Cloud, target: Cloud) -> float:
    """Sum, not halved, of the two mean squared nearest-neighbour distances. As PoinTr
    and CRA-PCN report it on ShapeNet-55."""
    return score(prediction, target).cd_l2


def f_score(
    prediction: Cloud, target: Cloud, threshold: float = F_SCORE_THRESHOLD
) -> float:
    """Harmonic mean of precision and recall at an unsquared distance, strictly below;
    zero when both are zero. Source: Tatarchenko et al., "What Do Single-view 3D
    Reconstruction Networks Learn?", CVPR 2019."""
    return score(prediction, target, threshold).f_score


def hausdorff(prediction: Cloud, target: Cloud) -> float:
    """The larger of the two greatest nearest-neighbour distances, symmetric."""
    return score(prediction, target).hausdorff


def from_distances(
    forward: Float[np.ndarray, " N"],
    backward: Float[np.ndarray, " M"],
    threshold: float = F_SCORE_THRESHOLD,
) -> Scores:
    """`score` of known distances: of the prediction's points to their nearest target
    points (`forward`), and the reverse."""
    precision, recall = np.mean(forward < threshold), np.mean(backward < threshold)
    both = precision + recall
    to_truth, from_truth = np.mean(forward**2), np.mean(backward**2)
    return Scores(
        cd_l2=float(to_truth + from_truth),
        cd_l1=float(0.5 * (forward.mean() + backward.mean())),
        f_score=float(2 * precision * recall / both) if both > 0 else 0.0,
        emd=None,
        hausdorff=float(max(forward.max(), backward.max())),
        prediction_to_truth=float(to_truth),
        truth_to_prediction=float(from_truth),
    )


def emd(prediction: Cloud, target: Cloud) -> float:
    """Mean unsquared distance of the best one-to-one assignment, exact. The clouds need
    equal counts of at most `MAX_EXACT_POINTS`, or ValueError. Memory is quadratic, time
    up to cubic; clouds in farthest-point order take less."""
    return emds([prediction], target)[0]


def emds(predictions: Sequence[Cloud], target: Cloud) -> list[float]:
    """`emd` of several clouds to one target: the same values as one by one. Faster for
    clouds that are alike: each starts from the assignment of the first."""
    values, prices = [], None
    for prediction in predictions:
        cloud, goal = _checked(prediction, target)
        if len(cloud) != len(goal):
            counts = f"{len(cloud)} and {len(goal)}"
            raise ValueError(f"emd needs equal counts, not {counts}: resample one")
        if len(cloud) > MAX_EXACT_POINTS:
            fault = f"emd takes up to {MAX_EXACT_POINTS} points, not {len(cloud)}"
            raise ValueError(f"{fault}: use fewer")
        cost = cdist(cloud, goal)
        start = _coarse_prices(cost) if prices is None else prices
        columns = scipy.optimize.linear_sum_assignment(_reduced(cost, start))[1]
        values.append(float(cost[np.arange(len(cost)), columns].mean()))
        if prices is None and len(predictions) > 1:
            prices = _relaxed(start, cost, columns, _ROUNDS)
    return values


def _reduced(cost: np.ndarray, prices: np.ndarray) -> np.ndarray:
    """The costs minus each column's price, and minus what is then each row's minimum.
    The best assignment stays the best; if the prices are close to its dual variables,
    SciPy's augmenting paths are short."""
    reduced = cost - prices
    reduced -= reduced.min(axis=1, keepdims=True)
    return reduced


def _coarse_prices(cost: np.ndarray) -> np.ndarray:
    """Prices from the assignment between the first three eighths of both clouds,
    extended to all columns."""
    few = 3 * len(cost) // 8
    if few < _FEWEST:
        return np.zeros(len(cost))
    coarse = cost[:few, :few]
    columns = scipy.optimize.linear_sum_assignment(coarse)[1]
    prices = _relaxed(np.zeros(few), coarse, columns, few)
    rows = np.min(cost[:, :few] - prices, axis=1, keepdims=True)
    return np.min(cost - rows, axis=0)


def _relaxed(
    prices: np.ndarray, cost: np.ndarray, columns: np.ndarray, rounds: int
) -> np.ndarray:
    """Prices closer to the dual variables of the best assignment, `columns`: shortest
    path lengths between columns, by Bellman-Ford, where an edge costs what the row
    assigned to one column would pay extra for the other."""
    more = cost - np.take_along_axis(cost, columns[:, None], axis=1)
    for _ in range(rounds):
        lower = np.minimum(prices, np.min(prices[columns][:, None] + more, axis=0))
        if (prices - lower).max() <= 1e-9 * cost.max():
            break
        prices = lower
    return prices


def _checked(
    prediction: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Both clouds in float64; faults are named."""
    clouds = []
    for name, cloud in (("prediction", prediction), ("target", target)):
        cloud = np.asarray(cloud, np.float64)
        if cloud.ndim != 2 or cloud.shape[1] != 3:
            raise ValueError(f"{name} must have shape (N, 3), not {cloud.shape}")
        if len(cloud) == 0:
            raise ValueError(f"{name} is empty")
        if not np.isfinite(cloud).all():
            raise ValueError(f"{name} has coordinates that are NaN or infinite")
        clouds.append(cloud)
    return clouds[0], clouds[1]
