"""Several results of one set of examples, side by side."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from prism_jax.evaluation.summary import KEPT, paired_difference, scores_of


class Row(NamedTuple):
    """One line of a comparison.

    Attributes:
      result: of `evaluate`.
      cloud: which of its clouds counts.
      parameters: of the network, if there is one.
      samples: that it was trained on, all trainings together.
    """

    result: Mapping[str, Any]
    cloud: str = "output"
    parameters: int | None = None
    samples: int | None = None


def comparison(rows: Mapping[str, Row], against: str, **about: Any) -> dict[str, Any]:
    """Means and intervals of every row, as JSON, and its change against one of them,
    but of metrics whose mean is zero there.

    ``about`` says what else names the comparison. Rows of other examples than those of
    ``against`` raise ValueError.
    """
    reference = rows[against]

    def entry(row: Row) -> dict[str, Any]:
        scores = scores_of(row.result, row.cloud)
        before = scores_of(reference.result, reference.cloud)["mean"]
        changes = {
            metric: paired_difference(
                reference.result, row.result, metric, (reference.cloud, row.cloud)
            )
            for metric in KEPT
            if before[metric] != 0
        }
        return {
            "mean": scores["mean"],
            "intervals": scores["intervals"],
            "change": {
                metric: {key: found[key] for key in ("change", "interval")}
                for metric, found in changes.items()
            },
            "parameters": row.parameters,
            "samples": row.samples,
        }

    named = ("unit", "num_examples", "num_objects")
    return {
        **about,
        **{name: reference.result[name] for name in named},
        "against": against,
        "rows": {label: entry(row) for label, row in rows.items()},
    }
