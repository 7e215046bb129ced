"""Scores of many examples as one result: means and intervals."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from experiments.paired import adaptation_effect, mean_intervals
from prism_jax.evaluation.metrics import Scores


class ExampleScores(NamedTuple):
    """One example: its name and category, whether its adaptation was accepted (None if
    it was not adapted), and the scores of its clouds."""

    name: str
    category: str
    accepted: bool | None
    clouds: dict[str, Scores]


def summarise(
    rows: Sequence[ExampleScores],
    categories: Sequence[str],
    objects: Int[np.ndarray, " E"],
) -> dict[str, Any]:
    """The part of `evaluate`'s result that is made of scores. `objects` numbers the
    object that each example shows. Intervals of means are over objects. Categories
    without an example are left out."""
    present = np.array([row.category for row in rows])
    clouds = {cloud: _columns(rows, cloud) for cloud in rows[0].clouds}

    def summary(columns: dict[str, np.ndarray]) -> dict[str, Any]:
        low, high = mean_intervals(np.stack([*columns.values()], axis=1), objects)
        known = {metric: int((~np.isnan(c)).sum()) for metric, c in columns.items()}
        return {
            "mean": _means(columns),
            "intervals": {m: [low[i], high[i]] for i, m in enumerate(columns)},
            "of": {m: count for m, count in known.items() if count < len(rows)},
            "per_category": {
                name: _means(columns, present == name)
                for name in categories
                if (present == name).any()
            },
        }

    accepted = [row.accepted for row in rows if row.accepted is not None]
    result = {
        "num_examples": len(rows),
        "num_objects": int(objects[-1]) + 1,
        **({"accepted": float(np.mean(accepted))} if accepted else {}),
        "clouds": {cloud: summary(columns) for cloud, columns in clouds.items()},
        "per_example": {
            "name": [row.name for row in rows],
            "category": present.tolist(),
            "object": objects.tolist(),
            "clouds": {
                cloud: {metric: [*map(_short, c)] for metric, c in columns.items()}
                for cloud, columns in clouds.items()
            },
        },
    }
    effect = adaptation_effect(result)
    return {**result, **({"adaptation": effect} if effect else {})}


def _columns(
    rows: Sequence[ExampleScores], cloud: str
) -> dict[str, Float[np.ndarray, " E"]]:
    """A cloud's scores by metric, NaN where an example has none; what all lack is left
    out."""
    values = np.array([row.clouds[cloud] for row in rows], np.float64)
    columns = zip(Scores._fields, values.T, strict=True)
    return {metric: column for metric, column in columns if not np.isnan(column).all()}


def _means(columns: dict[str, np.ndarray], chosen: Any = ...) -> dict[str, float]:
    """Over those of the chosen examples that have the metric, if any has."""
    known = {metric: c[chosen][~np.isnan(c[chosen])] for metric, c in columns.items()}
    return {metric: float(c.mean()) for metric, c in known.items() if len(c)}


def _short(value: float) -> float | None:
    """The number with the digits of single precision, which JSON then shows."""
    return None if np.isnan(value) else float(str(np.float32(value)))
