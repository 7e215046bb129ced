"""Boosted trees that `prism_jax.trees` reads, and which samples they are fitted on."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import spearmanr

from prism_jax.io.errors import require

FOLDS = 5
"""That cross-validation leaves out in turn."""


def numbered(count: int) -> Int[np.ndarray, " count"]:
    """Random numbers of a set's objects, the same for every fit."""
    return np.random.default_rng(0).permutation(count)


def boosted(
    found: Float[np.ndarray, "N E"],
    wanted: Float[np.ndarray, " N"],
    weights: Float[np.ndarray, " N"],
    **settings: Any,
) -> Any:
    """Gradient boosting (Friedman 2001) by scikit-learn; the same every time."""
    ensemble = require("sklearn.ensemble", "train")
    model = ensemble.GradientBoostingRegressor(
        subsample=0.5, random_state=0, **settings
    )
    return model.fit(found, wanted, sample_weight=weights)


def cross_predicted(
    found: Float[np.ndarray, "N E"],
    wanted: Float[np.ndarray, " N"],
    weights: Float[np.ndarray, " N"],
    fold: Int[np.ndarray, " N"],
    **settings: Any,
) -> Float[np.ndarray, " N"]:
    """What `boosted` says of each fold's samples, fitted on those of all others."""
    said = np.empty(len(wanted))
    for number in np.unique(fold):
        others, own = fold != number, fold == number
        model = boosted(found[others], wanted[others], weights[others], **settings)
        said[own] = model.predict(found[own])
    return said


def complete_trees(
    model: Any, depth: int
) -> tuple[
    Float[np.ndarray, "T N"], Float[np.ndarray, "T N"], Float[np.ndarray, "T L"]
]:
    """Its trees as `Trees` has them: below an early leaf all is that leaf."""
    inner = 2**depth - 1
    looks_at, thresholds = np.zeros((2, len(model.estimators_), inner))
    leaves = np.zeros((len(model.estimators_), inner + 1))
    for row, (estimator,) in enumerate(model.estimators_):
        tree, at = estimator.tree_, np.zeros(2 * inner + 1, int)
        for node in range(inner):
            here = at[node]
            is_leaf = tree.children_left[here] < 0
            looks_at[row, node] = 0 if is_leaf else tree.feature[here]
            thresholds[row, node] = 0 if is_leaf else tree.threshold[here]
            at[2 * node + 1] = here if is_leaf else tree.children_left[here]
            at[2 * node + 2] = here if is_leaf else tree.children_right[here]
        leaves[row] = model.learning_rate * tree.value[at[inner:], 0, 0]
    return looks_at, thresholds, leaves


def rank_correlation(
    first: Float[np.ndarray, " N"], second: Float[np.ndarray, " N"]
) -> float | None:
    """Spearman's; None where all of one are equal."""
    if len(first) == 0 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(spearmanr(first, second).statistic)
