"""Scores of many examples as one result: means, medians and intervals."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from prism_jax.evaluation.bootstrap import mean_intervals
from prism_jax.evaluation.metrics import Scores
from prism_jax.evaluation.paired import adaptation_effect


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
    clouds = {
        cloud: [row.clouds[cloud].named() for row in rows] for cloud in rows[0].clouds
    }

    def summary(named: Sequence[dict[str, float]]) -> dict[str, Any]:
        metrics = list(named[0])
        values = np.array([list(one.values()) for one in named])
        low, high = mean_intervals(values, objects)

        def by_metric(numbers: np.ndarray) -> dict[str, float]:
            return dict(zip(metrics, numbers.tolist(), strict=True))

        return {
            "mean": by_metric(values.mean(0)),
            "median": by_metric(np.median(values, axis=0)),
            "intervals": {m: [low[i], high[i]] for i, m in enumerate(metrics)},
            "per_category": {
                name: by_metric(values[present == name].mean(0))
                for name in categories
                if (present == name).any()
            },
        }

    accepted = [row.accepted for row in rows if row.accepted is not None]
    result = {
        "num_examples": len(rows),
        "num_objects": int(objects[-1]) + 1,
        **({"accepted": float(np.mean(accepted))} if accepted else {}),
        "clouds": {cloud: summary(named) for cloud, named in clouds.items()},
        "per_example": {
            "name": [row.name for row in rows],
            "category": present.tolist(),
            "object": objects.tolist(),
            "clouds": {
                cloud: {m: [_short(one[m]) for one in named] for m in named[0]}
                for cloud, named in clouds.items()
            },
        },
    }
    effect = adaptation_effect(result)
    return {**result, **({"adaptation": effect} if effect else {})}


def _short(value: float) -> float:
    """The number with the digits of single precision, which JSON then shows."""
    return float(str(np.float32(value)))
