"""How much a metric differs between two clouds of the same examples, and where.

Intervals are 95 % percentile bootstrap intervals over groups of examples that belong
together. Views of one object are not independent, so whole groups are drawn, with all
of their examples. With fewer than some ten groups an interval is rough, and rather too
narrow.
"""

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from prism_jax.evaluation.tables import MEASURES

_RESAMPLES = 2000
_QUANTILES = (0.025, 0.975)

ADAPTED = ("network", "completed")  # clouds that there are unadapted, too
STATISTICS = {"mean": (np.asarray, np.asarray), "log mean": (np.log, np.exp)}
"""Into what the mean is taken of, and back: a change of a mean log is a factor."""


class NoChangeError(ValueError):
    """There is no relative change: no example has the metric, or it is zero before."""


def paired_difference(
    a: Mapping[str, Any],
    b: Mapping[str, Any],
    metric: str = "cd_l2",
    clouds: tuple[str, str] = ("network", "network"),
    statistic: str = "mean",
) -> dict[str, Any]:
    """How much higher a metric is in `b` than in `a`, as a share of what it is in `a`.

    `a` and `b` are results of the same examples, from `evaluate` or read from its JSON;
    `clouds` names what to compare in each.

    Returns `change` (-0.1 is ten percent lower) of the `statistic`, and its 95 %
    bootstrap `interval` over objects. Both sides are drawn together, so that what is
    hard for both cancels out. What holds for other categories is told by
    `category_interval`, if there are several. `carried_by` names the `category` with
    the largest part in a mean's change: its `contribution`, its number of examples, and
    what is left without it.

    Only examples count that have the metric in both. Other examples raise ValueError,
    no such example and a zero in `a` NoChangeError.
    """
    values, objects, kinds = _columns(a, b, metric, clouds)
    names, categories = np.unique(kinds, return_inverse=True)
    change, interval = _change(values, objects, statistic)
    found = {
        "change": change,
        "interval": interval,
        "num_examples": len(values),
        "num_objects": len(np.unique(objects)),
        "num_categories": len(names),
    }
    if len(names) > 1:
        found["category_interval"] = _change(values, categories, statistic)[1]
    if len(names) > 1 and statistic == "mean" and change != 0:
        found["carried_by"] = _carrier(values, objects, categories, names)
    return found


def _columns(
    a: Mapping[str, Any], b: Mapping[str, Any], metric: str, clouds: tuple[str, str]
) -> tuple[Float[np.ndarray, "E 2"], np.ndarray, np.ndarray]:
    """A metric of the same examples in two results, their objects and categories."""
    each, same = a["per_example"], ("name", "object", "category")
    if any(each[key] != b["per_example"][key] for key in same):
        raise ValueError("the two results are not of the same examples in one order")
    columns = []
    for result, cloud in zip((a, b), clouds, strict=True):
        scores = result["per_example"]["clouds"][cloud]
        columns.append(scores.get(metric, [None] * len(each["name"])))
    values = np.array(columns, np.float64).T
    known = ~np.isnan(values).any(axis=1)
    if not known.any():
        raise NoChangeError(f"no example has {metric} of {' and '.join(clouds)}")
    objects, kinds = (np.array(each[key])[known] for key in same[1:])
    return values[known], objects, kinds


def _change(
    values: Float[np.ndarray, "E 2"], groups: np.ndarray, statistic: str = "mean"
) -> tuple[float, list[float]]:
    """How much the second column is above the first, and the interval over groups."""
    into, back = STATISTICS[statistic]
    with np.errstate(divide="ignore"):
        inside = into(values)
    before, after = back(inside.mean(0))
    if before == 0:
        raise NoChangeError(f"the {statistic} is zero in a: no relative change")
    numbers = np.unique(groups, return_inverse=True)[1]
    interval = change_interval(back(resampled_means(inside, numbers)))
    return float(after / before - 1), interval


def _carrier(
    values: Float[np.ndarray, "E 2"],
    objects: np.ndarray,
    categories: np.ndarray,
    names: np.ndarray,
) -> dict[str, Any]:
    """The category that contributes most to the change of the mean."""
    before, after = values.T
    parts = np.bincount(categories, after - before) / before.sum()
    most = int(np.argmax(parts * np.sign(parts.sum())))
    rest = categories != most
    found = {
        "category": str(names[most]),
        "contribution": float(parts[most]),
        "num_examples": int((~rest).sum()),
    }
    with contextlib.suppress(NoChangeError):
        without = _change(values[rest], objects[rest])
        found["change_without"], found["interval_without"] = without
    return found


def all_differences(
    a: Mapping[str, Any], b: Mapping[str, Any], clouds: tuple[str, str]
) -> dict[str, Any]:
    """`paired_difference` of all `MEASURES` that have one."""
    found = {}
    for name, (metric, statistic, _) in MEASURES.items():
        with contextlib.suppress(NoChangeError):
            found[name] = paired_difference(a, b, metric, clouds, statistic)
    return found


def adaptation_effect(result: Mapping[str, Any]) -> dict[str, Any]:
    """What adaptation changes in each of a result's clouds that are `ADAPTED`."""
    return {
        cloud: all_differences(result, result, (f"{cloud}_unadapted", cloud))
        for cloud in ADAPTED
        if f"{cloud}_unadapted" in result["per_example"]["clouds"]
    }


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
