"""The columns of published tables, for results of the published protocols.

ShapeNet-55 and -34 (Yu et al., "PoinTr", ICCV 2021): the test objects from eight fixed
viewpoints, 25, 50 and 75 % of the points removed (easy, median, hard); CD-L2 x1e3 as
CD-S, CD-M, CD-H and their mean, and F-score at 1 %, in the data set's own unit. An
average is the mean over categories of each category's mean, as PoinTr's released
evaluation takes it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from prism_jax.evaluation.tables import clouds_of, table_lines, title

PUBLISHED = ("shapenet55", "shapenet34", "shapenet_unseen21")
"""Data sets with a published protocol for their test split."""

_LETTERS = {"easy": "S", "median": "M", "hard": "H"}


OPTIONS = {"difficulty": "all"}  # of `open_dataset`, for the published test


def published_columns(
    result: Mapping[str, Any], cloud: str = "network"
) -> dict[str, float]:
    """The columns of the published table, scaled as there.

    `result` comes from `evaluate` on the test split, opened with `OPTIONS`, in the data
    set's own unit. `cloud` is one of its clouds.
    """
    scores = result["clouds"][cloud]["per_category"]
    f_score = float(np.mean([means["f_score"] for means in scores.values()]))
    columns = {
        f"CD-{letter}": _of_difficulty(result["per_example"], cloud, difficulty)
        for difficulty, letter in _LETTERS.items()
    }
    average = float(np.mean(list(columns.values())))
    return {**columns, "CD-Avg": average, "F-Score@1%": f_score}


def _of_difficulty(examples: Mapping[str, Any], cloud: str, difficulty: str) -> float:
    """CD-L2 x1e3 of the examples whose names hold this difficulty."""
    by_category: dict[str, list[float]] = {}
    values = examples["clouds"][cloud]["cd_l2"]
    for name, category, value in zip(
        examples["name"], examples["category"], values, strict=True
    ):
        if name.split("/")[1] == difficulty:
            by_category.setdefault(category, []).append(value)
    return 1e3 * float(np.mean([np.mean(rows) for rows in by_category.values()]))


def published_markdown(result: Mapping[str, Any]) -> str:
    """What names the result, and the columns of the published table."""
    columns = {name: published_columns(result, name) for name in clouds_of(result)}
    rows = [
        [name, *(f"{value:.4g}" for value in row.values())]
        for name, row in columns.items()
    ]
    table = table_lines(["CD-L2 x1e3", *next(iter(columns.values()))], rows)
    return "\n".join([f"{title(result)}\n", *table, ""])
