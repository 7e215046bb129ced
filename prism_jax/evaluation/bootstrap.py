"""95 % percentile bootstrap intervals over groups of examples that belong together.

Views of one object are not independent, so whole groups are drawn, with all of their
examples. With fewer than some ten groups an interval is rough, and rather too narrow.
"""

import numpy as np
from jaxtyping import Float, Int

_RESAMPLES = 2000
_QUANTILES = (0.025, 0.975)


def mean_intervals(
    values: Float[np.ndarray, "E K"], groups: Int[np.ndarray, " E"]
) -> tuple[list[float], list[float]]:
    """Lower and upper bounds of each column's mean, with `groups` numbered from 0."""
    low, high = np.nanquantile(resampled_means(values, groups), _QUANTILES, axis=0)
    return low.tolist(), high.tolist()


def change_interval(resampled: Float[np.ndarray, "R 2"]) -> list[float]:
    """Bounds of how much the second column is above the first, as a share of it."""
    before, after = resampled.T
    changes = (after - before) / np.where(before == 0, 1, before)
    return np.quantile(changes, _QUANTILES, axis=0).tolist()


def resampled_means(
    values: Float[np.ndarray, "E K"], groups: Int[np.ndarray, " E"]
) -> Float[np.ndarray, "R K"]:
    """Means over examples of every resample, without what is NaN; NaN if all is."""
    known = ~np.isnan(values)
    sums, counts = np.zeros((2, int(groups.max()) + 1, values.shape[1]))
    np.add.at(sums, groups, np.where(known, values, 0.0))
    np.add.at(counts, groups, known)
    means = []
    for drawn in _draws(len(sums)):
        count = counts[drawn].sum(0)
        means.append(sums[drawn].sum(0) / np.where(count == 0, np.nan, count))
    return np.array(means)


def _draws(count: int):
    rng = np.random.default_rng(0)
    return (rng.integers(0, count, count) for _ in range(_RESAMPLES))
