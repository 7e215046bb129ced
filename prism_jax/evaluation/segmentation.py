"""How well a scene was taken apart, where it is known whose each point is."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from prism_jax.observation.scene import SUPPORT

MIN_POINTS = 500
"""Things of more points than that are asked after."""

WELL = 0.7
"""Intersection over union above which a thing counts as found."""

MOST, SOME = 0.5, 0.1
"""Shares of a thing's points: what holds most of it, and what is a piece of it."""


class Agreement(NamedTuple):
    """Found objects against true things, of more than so many points each.

    Attributes:
      overlap: of each thing with the object that has most in common with it:
        intersection over union.
      merged: whether the object that has most of it holds most of another thing too.
      split: whether a second object has more than `SOME` of it.
      lost: whether less than `MOST` of it is in objects at all.
      support_recall, support_precision: shares, of what is on planes and set aside;
        points that truly belong to nothing do not count. NaN of none.
      num_spurious: objects most of whose points are of no thing.
    """

    overlap: Float64[np.ndarray, " K"]
    merged: Bool[np.ndarray, " K"]
    split: Bool[np.ndarray, " K"]
    lost: Bool[np.ndarray, " K"]
    support_recall: float
    support_precision: float
    num_spurious: int


def agreement(
    labels: Int[np.ndarray, " N"],
    found: Int[np.ndarray, " N"],
    min_points: int = MIN_POINTS,
) -> Agreement:
    """Both number objects from 0, and say `SUPPORT` or `LEFT_OVER` of other points.

    Things of no more than `min_points` points can be what others are merged with, and
    are not asked after themselves.
    """
    num_things, num_found = labels.max(initial=-1) + 1, found.max(initial=-1) + 1
    common = np.zeros((num_things, num_found))
    both = (labels >= 0) & (found >= 0)
    np.add.at(common, (labels[both], found[both]), 1)
    size = np.bincount(labels[labels >= 0], minlength=num_things)
    found_size = np.bincount(found[found >= 0], minlength=num_found)
    # So that there is an object to ask where none was found.
    common = np.pad(common, [(0, 0), (0, 1)])
    union = size[:, None] + np.append(found_size, 0) - common
    share = common / np.maximum(size[:, None], 1)
    main = common.argmax(axis=1)
    holds = share > MOST
    others = holds[:, main].sum(axis=0) - holds[np.arange(num_things), main]
    asked = size > min_points
    on, set_aside = labels == SUPPORT, (found == SUPPORT) & (labels >= SUPPORT)
    return Agreement(
        overlap=(common / np.maximum(union, 1)).max(axis=1)[asked],
        merged=((others > 0) & (common.max(axis=1) > 0))[asked],
        split=(np.sort(share, axis=1)[:, -2:-1] > SOME).any(axis=1)[asked],
        lost=(share.sum(axis=1) < MOST)[asked],
        support_recall=_share(on & set_aside, on),
        support_precision=_share(on & set_aside, set_aside),
        num_spurious=int((common.sum(axis=0)[:-1] < MOST * found_size).sum()),
    )


def _share(some: Bool[np.ndarray, " N"], of: Bool[np.ndarray, " N"]) -> float:
    return float(some.sum() / of.sum()) if of.any() else float("nan")
