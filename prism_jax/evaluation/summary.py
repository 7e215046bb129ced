"""Means of scores with intervals over the objects, and differences of two results."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from prism_jax.evaluation.scoring import METRICS

KEPT = ("cd_l2", "f_score")
"""Metrics of which every example's value stays in a result."""

_RESAMPLES = 2000


class Scores(NamedTuple):
    """One example's: its name and category, whether its adaptation was accepted if it
    was adapted, and every cloud's metrics."""

    name: str
    category: str
    accepted: bool | None
    clouds: dict[str, dict[str, float]]


def summarise(
    rows: Sequence[Scores], categories: Sequence[str], objects: Int[np.ndarray, " E"]
) -> dict[str, Any]:
    """A result, as `evaluate` describes it, of examples and the object that each shows.

    Intervals are 95 % percentile bootstraps over objects: views of one are not
    independent. Categories without an example are left out.
    """
    present = np.array([row.category for row in rows])
    metrics = [metric for metric in METRICS if metric in rows[0].clouds["output"]]

    def summary(cloud: str) -> dict[str, Any]:
        values = np.array([[row.clouds[cloud][m] for m in metrics] for row in rows])
        low, high = mean_intervals(values, objects)

        def named(means: np.ndarray) -> dict[str, float]:
            return dict(zip(metrics, means.tolist(), strict=True))

        return {
            "mean": named(values.mean(0)),
            "intervals": {m: [low[i], high[i]] for i, m in enumerate(metrics)},
            "per_category": {
                name: named(values[present == name].mean(0))
                for name in categories
                if (present == name).any()
            },
        }

    accepted = [row.accepted for row in rows if row.accepted is not None]
    others = [cloud for cloud in rows[0].clouds if cloud != "output"]
    return {
        "num_examples": len(rows),
        "num_objects": int(objects[-1]) + 1,
        **({"accepted": float(np.mean(accepted))} if accepted else {}),
        **summary("output"),
        **{cloud: summary(cloud) for cloud in others},
        "per_example": {
            "name": [row.name for row in rows],
            "category": present.tolist(),
            "object": objects.tolist(),
            **{
                cloud: {m: [_short(row.clouds[cloud][m]) for row in rows] for m in KEPT}
                for cloud in rows[0].clouds
            },
        },
    }


def scores_of(result: Mapping[str, Any], cloud: str) -> Mapping[str, Any]:
    """``mean``, ``intervals`` and ``per_category`` of one of a result's clouds."""
    return result if cloud == "output" else result[cloud]


def paired_difference(
    a: Mapping[str, Any],
    b: Mapping[str, Any],
    metric: str = "cd_l2",
    clouds: tuple[str, str] = ("output", "output"),
) -> dict[str, Any]:
    """How much higher the mean of `metric` is in `b` than in `a`, as a share of a's.

    `a` and `b` are results of the same examples, as `evaluate` returns them or as their
    JSON is read; `metric` is one of `KEPT`, `clouds` names what to compare in each, so
    that `paired_difference(r, r, clouds=("unadapted", "output"))` is what adaptation
    changes. Returns ``change`` (-0.1 is ten percent lower) and ``interval``, its 95 %
    percentile bootstrap over objects, drawn for both at once: what is hard for both
    cancels out. Other examples, a metric or a cloud that is not there, or a mean of
    zero in `a`, raise ValueError.
    """
    if any(a["per_example"][k] != b["per_example"][k] for k in ("name", "object")):
        raise ValueError("the two results are not of the same examples in one order")
    columns = []
    for result, cloud in zip((a, b), clouds, strict=True):
        try:
            columns.append(result["per_example"][cloud][metric])
        except (KeyError, TypeError):
            raise ValueError(f"a result has no {metric} of {cloud}") from None
    values = np.array(columns, np.float64).T
    sums = _sums(values, np.array(a["per_example"]["object"]))
    before, after = values.mean(0)
    if before == 0:
        raise ValueError(f"the mean {metric} of a is zero: there is no relative change")
    means = _resampled_means(sums)
    changes = (means[:, 1] - means[:, 0]) / np.where(means[:, 0] == 0, 1, means[:, 0])
    low, high = np.quantile(changes, [0.025, 0.975]).tolist()
    return {
        "change": float(after / before - 1),
        "interval": [low, high],
        "num_examples": len(values),
        "num_objects": len(sums),
    }


def mean_intervals(
    values: Float[np.ndarray, "E K"], objects: Int[np.ndarray, " E"]
) -> tuple[list[float], list[float]]:
    """Bounds of the 95 % percentile bootstrap intervals of each column's mean.

    Objects are drawn, with all of their examples.
    """
    means = _resampled_means(_sums(values, objects))
    low, high = np.quantile(means, [0.025, 0.975], axis=0)
    return low.tolist(), high.tolist()


def _sums(
    values: Float[np.ndarray, "E K"], objects: Int[np.ndarray, " E"]
) -> Float[np.ndarray, "G K+1"]:
    """The objects' sums of values, and in the last column the numbers of examples."""
    rows = np.column_stack([values, np.ones(len(values))])
    sums = np.zeros((int(objects.max()) + 1, rows.shape[1]))
    np.add.at(sums, objects, rows)
    return sums


def _resampled_means(sums: Float[np.ndarray, "G K"]) -> Float[np.ndarray, "R K-1"]:
    rng = np.random.default_rng(0)
    means = []
    for _ in range(_RESAMPLES):
        total = sums[rng.integers(0, len(sums), len(sums))].sum(0)
        means.append(total[:-1] / total[-1])
    return np.array(means)


def _short(value: float) -> float:
    """The number with the digits of single precision, which JSON then shows."""
    return float(str(np.float32(value)))
