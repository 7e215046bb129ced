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
    resampled = resampled_means(values, groups)
    low, high = np.quantile(resampled, _QUANTILES, axis=0)
    return low.tolist(), high.tolist()


def change_interval(resampled: Float[np.ndarray, "R 2"]) -> list[float]:
    """Bounds of how much the second column is above the first, as a share of it."""
    before, after = resampled.T
    changes = (after - before) / np.where(before == 0, 1, before)
    return np.quantile(changes, _QUANTILES, axis=0).tolist()


def resampled_means(
    values: Float[np.ndarray, "E K"], groups: Int[np.ndarray, " E"]
) -> Float[np.ndarray, "R K"]:
    """Means over examples of every resample."""
    rows = np.column_stack([values, np.ones(len(values))])
    sums = np.zeros((int(groups.max()) + 1, rows.shape[1]))
    np.add.at(sums, groups, rows)
    means = []
    for drawn in _draws(len(sums)):
        total = sums[drawn].sum(0)
        means.append(total[:-1] / total[-1])
    return np.array(means)


def resampled_medians(
    values: Float[np.ndarray, "E K"], groups: Int[np.ndarray, " E"]
) -> Float[np.ndarray, "R K"]:
    """Medians over examples of every resample."""
    order = np.argsort(values, axis=0)
    ordered = np.take_along_axis(values, order, axis=0)
    count = int(groups.max()) + 1
    medians = np.empty((_RESAMPLES, values.shape[1]))
    for row, drawn in zip(medians, _draws(count), strict=True):
        times = np.bincount(drawn, minlength=count)[groups]
        for column in range(len(row)):
            below = np.cumsum(times[order[:, column]])
            # The two middle ones; they are one if the number of examples is odd.
            middle = np.array([(below[-1] - 1) // 2, below[-1] // 2])
            places = np.searchsorted(below, middle, side="right")
            row[column] = ordered[places, column].mean()
    return medians


def _draws(count: int):
    rng = np.random.default_rng(0)
    return (rng.integers(0, count, count) for _ in range(_RESAMPLES))
