"""Several results of one set of examples, side by side."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from prism_jax.evaluation.paired import all_differences
from prism_jax.evaluation.tables import (
    change_cells,
    columns_of,
    score_cells,
    table_lines,
    title,
)


class Row(NamedTuple):
    """One line of a comparison.

    Attributes:
      result: from `evaluate`.
      cloud: which of its clouds counts.
      parameters: of the network, if there is one.
      samples: that it was trained on, all trainings together.
    """

    result: Mapping[str, Any]
    cloud: str = "network"
    parameters: int | None = None
    samples: int | None = None


ABOVE = "the row above"


def comparison(rows: Mapping[str, Row], against: str, **about: Any) -> dict[str, Any]:
    """Means, medians and intervals of every row, and its ``change`` against the row
    `against`, or against `ABOVE` (`paired_difference`), as JSON.

    What is zero in that row has no change. `about` is what else names the comparison.
    Rows of other examples than those of that row raise ValueError.
    """
    labels = list(rows)
    above = dict(zip(labels[1:], labels, strict=False))
    reference = rows[labels[0] if against == ABOVE else against]

    def entry(label: str, row: Row) -> dict[str, Any]:
        before = rows[above.get(label, label)] if against == ABOVE else reference
        scores = row.result["clouds"][row.cloud]
        clouds = (before.cloud, row.cloud)
        return {
            **{name: scores[name] for name in ("mean", "median", "intervals")},
            "change": all_differences(before.result, row.result, clouds),
            "parameters": row.parameters,
            "samples": row.samples,
        }

    named = ("unit", "num_examples", "num_objects")
    return {
        **about,
        **{name: reference.result[name] for name in named},
        "against": against,
        "rows": {label: entry(label, row) for label, row in rows.items()},
    }


def comparison_markdown(table: Mapping[str, Any]) -> str:
    """What names a `comparison`, and its rows."""
    rows, against = table["rows"], table["against"]
    unchanged = next(iter(rows)) if against == ABOVE else against
    columns = columns_of(next(iter(rows.values())))
    counted = any(row["parameters"] for row in rows.values())
    changes = {
        label: None if label == unchanged else row["change"].get("cd_l2")
        for label, row in rows.items()
    }
    heads, cells = change_cells(changes, f"CD-L2 against {against}")
    lines = []
    for (label, row), change in zip(rows.items(), cells, strict=True):
        line = [label, *score_cells(row, columns), *change]
        if counted:
            number = row["parameters"]
            line.append(f"{number / 1e6:.2f} M" if number else "")
            line.append(f"{row['samples']:,}" if row["samples"] else "")
        lines.append(line)
    head = ["", *(column.head for column in columns), *heads]
    head += ["parameters", "samples"] if counted else []
    return "\n".join([f"{title(table)}\n", *table_lines(head, lines), ""])
