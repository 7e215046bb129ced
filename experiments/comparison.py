"""Several results of one set of examples, side by side."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from experiments.paired import all_differences
from prism_jax.evaluation.tables import (
    MEASURES,
    change_cells,
    columns_of,
    percent,
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
DECISIVE = ("log_cd_l1", "f_2")
"""What one of two weights is chosen by, of `MEASURES`."""


def comparison(rows: Mapping[str, Row], against: str, **about: Any) -> dict[str, Any]:
    """What was found for every row, and its ``change`` against the row `against`, or
    against `ABOVE` (`all_differences`), as JSON.

    `about` is what else names the comparison. Rows of other examples than those of that
    row raise ValueError.
    """
    labels = list(rows)
    above = dict(zip(labels[1:], labels, strict=False))
    reference = rows[labels[0] if against == ABOVE else against]

    def entry(label: str, row: Row) -> dict[str, Any]:
        before = rows[above.get(label, label)] if against == ABOVE else reference
        scores = row.result["clouds"][row.cloud]
        clouds = (before.cloud, row.cloud)
        return {
            **{name: scores[name] for name in ("mean", "intervals", "of")},
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
    """What names a `comparison`, its rows, and their changes."""
    rows, against = table["rows"], table["against"]
    unchanged = next(iter(rows)) if against == ABOVE else against
    columns = columns_of(rows.values(), 5)
    counted = any(row["parameters"] for row in rows.values())
    lines = []
    for label, row in rows.items():
        lines.append([label, *score_cells(row, columns)])
        if counted:
            number, samples = row["parameters"], row["samples"]
            lines[-1].append(f"{number / 1e6:.2f} M" if number else "")
            lines[-1].append(f"{samples:,}" if samples else "")
    head = ["", *(column.head for column in columns)]
    head += ["parameters", "samples"] if counted else []
    found = {label: row["change"] for label, row in rows.items() if label != unchanged}
    heads, cells = change_cells({k: c.get("cd_l2") for k, c in found.items()}, "CD-L2")
    changes = []
    for (label, change), cell in zip(found.items(), cells, strict=True):
        decisive = (change.get(name) for name in DECISIVE)
        told = [percent(c["change"], c["interval"]) if c else "" for c in decisive]
        changes.append([label, *told, *cell])
    heads = [f"against {against}", *(MEASURES[name][2] for name in DECISIVE), *heads]
    tables = [*table_lines(head, lines), "", *table_lines(heads, changes)]
    return "\n".join([f"{title(table)}\n", *tables, ""])
