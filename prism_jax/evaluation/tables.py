"""Results as Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from prism_jax.evaluation.paired import MEASURES
from prism_jax.evaluation.published import published_columns
from prism_jax.evaluation.scoring import CLOUDS


class Column(NamedTuple):
    """How a table shows a metric."""

    statistic: str
    metric: str
    head: str
    factor: float


COLUMNS = (
    Column("mean", "cd_l2", "CD-L2 x1e4", 1e4),
    Column("mean", "cd_l1", "CD-L1 x1e3", 1e3),
    Column("mean", "f_score", "F@0.01", 1.0),
    Column("mean", "emd", "EMD x1e2", 1e2),
    Column("mean", "hausdorff", "HD x1e2", 1e2),
    Column("median", "cd_l2", "median CD-L2 x1e4", 1e4),
    Column("mean", "prediction_to_truth", "prediction to truth x1e4", 1e4),
    Column("mean", "truth_to_prediction", "truth to prediction x1e4", 1e4),
)

LABELS = {
    "cd_l2": "CD-L2",
    "cd_l2_median": "median CD-L2",
    "prediction_to_truth": "prediction to truth",
    "truth_to_prediction": "truth to prediction",
    "cd_l1": "CD-L1",
    "f_score": "F@0.01",
}
"""`MEASURES` in words."""


def markdown(result: Mapping[str, Any]) -> str:
    """What the result is of, the means with their intervals, CD-L2 by category, and
    what adaptation changes."""
    clouds = {name: result["clouds"][name] for name in _clouds(result)}
    columns = _columns(clouds["network"])
    categories = list(clouds["network"]["per_category"])
    means, by_category = [], []
    for name, scores in clouds.items():
        means.append([name, *_scores(scores, columns)])
        cells = [scores["per_category"][name]["cd_l2"] for name in categories]
        by_category.append([name, *(f"{1e4 * cell:.4g}" for cell in cells)])
    lines = [
        f"{_title(result)}\n",
        *_table(["", *(column.head for column in columns)], means),
        "",
        *_table(["CD-L2 x1e4", *categories], by_category),
        "",
    ]
    changes = {
        f"{cloud}, {LABELS[measure]}": found[measure]
        for cloud, found in result.get("adaptation", {}).items()
        for measure in MEASURES
        if measure in found
    }
    if changes:
        heads, cells = _changes(changes, "adaptation changes")
        rows = [[label, *row] for label, row in zip(changes, cells, strict=True)]
        lines += [*_table(["", *heads], rows), ""]
    return "\n".join(lines)


def comparison_markdown(table: Mapping[str, Any]) -> str:
    """What names a `comparison`, and its rows."""
    rows, against = table["rows"], table["against"]
    columns = _columns(next(iter(rows.values())))
    counted = any(row["parameters"] for row in rows.values())
    changes = {
        label: None if label == against else row["change"].get("cd_l2")
        for label, row in rows.items()
    }
    heads, cells = _changes(changes, f"CD-L2 against {against}")
    lines = []
    for (label, row), change in zip(rows.items(), cells, strict=True):
        line = [label, *_scores(row, columns), *change]
        if counted:
            number = row["parameters"]
            line.append(f"{number / 1e6:.2f} M" if number else "")
            line.append(f"{row['samples']:,}" if row["samples"] else "")
        lines.append(line)
    head = ["", *(column.head for column in columns), *heads]
    head += ["parameters", "samples"] if counted else []
    return "\n".join([f"{_title(table)}\n", *_table(head, lines), ""])


def agreement_markdown(result: Mapping[str, Any]) -> str:
    """What names the result of `gradient_agreement`, and its rows."""
    rows = []
    for label, row in result["losses"].items():
        low, high = row["interval"]
        mean = f"{row['mean']:+.3f} [{low:+.3f}, {high:+.3f}]"
        change = percent(row["change"], row["change_interval"])
        rows.append([label, mean, f"{100 * row['positive']:.0f} %", change])
    head = ["gradient of", f"cosine with that of {result['error']}", "positive"]
    head.append(f"the error after a step of length {result['step_length']:g}")
    return "\n".join([f"{_title(result)}\n", *_table(head, rows), ""])


def _columns(scores: Mapping[str, Any]) -> list[Column]:
    """Those whose numbers are there."""
    return [c for c in COLUMNS if c.metric in scores.get(c.statistic, {})]


def _scores(scores: Mapping[str, Any], columns: Sequence[Column]) -> list[str]:
    """The cells of one cloud; means have intervals."""
    cells = []
    for statistic, metric, _, factor in columns:
        cell = f"{factor * scores[statistic][metric]:.4g}"
        if statistic == "mean":
            low, high = (factor * bound for bound in scores["intervals"][metric])
            cell += f" [{low:.4g}, {high:.4g}]"
        cells.append(cell)
    return cells


def _changes(
    changes: Mapping[str, Mapping[str, Any] | None], head: str
) -> tuple[list[str], list[list[str]]]:
    """Heads and cells of paired differences; those over categories only if there are
    several."""
    known = [change for change in changes.values() if change is not None]
    several = any("category_interval" in change for change in known)
    heads = [head]
    if several:
        count = known[0]["num_categories"]
        heads += [f"over {count} categories", "carried by", "without it"]
    cells = []
    for change in changes.values():
        if change is None:
            cells.append([""] * len(heads))
            continue
        row = [percent(change["change"], change["interval"])]
        if several:
            row += [interval_text(change["category_interval"]), *_carrier(change)]
        cells.append(row)
    return heads, cells


def _carrier(change: Mapping[str, Any]) -> tuple[str, str]:
    """Which category carries a change, and what is left without it."""
    if "carried_by" not in change:
        return "", ""
    found = change["carried_by"]
    of = f"{found['num_examples']} of {change['num_examples']}"
    by = f"{found['category']} ({of}): {100 * found['contribution']:+.1f} %"
    if "change_without" not in found:
        return by, ""
    return by, percent(found["change_without"], found["interval_without"])


def percent(change: float, interval: Sequence[float]) -> str:
    """A relative change and its interval."""
    return f"{100 * change:+.1f} % {interval_text(interval)}"


def interval_text(bounds: Sequence[float]) -> str:
    """In per cent."""
    low, high = (f"{100 * bound:+.1f}" for bound in bounds)
    return f"[{low}, {high}]"


def published_markdown(dataset: str, result: Mapping[str, Any]) -> str:
    """What names the result, and the columns of the data set's published table."""
    columns = {
        name: published_columns(dataset, result, name) for name in _clouds(result)
    }
    head = "CD-L1 x1e3" if dataset == "pcn" else "CD-L2 x1e3"
    rows = [
        [name, *(f"{value:.4g}" for value in row.values())]
        for name, row in columns.items()
    ]
    table = _table([head, *next(iter(columns.values()))], rows)
    return "\n".join([f"{_title(result)}\n", *table, ""])


def _title(result: Mapping[str, Any]) -> str:
    """One line on what the result was made from, as far as is known."""
    named = ("data", "split", "digest", "protocol", "normalisation", "weights", "seed")
    named += ("steps", "set")
    parts = [f"{name} {result[name]}" for name in named if name in result]
    parts += [f"commit {short(result['commit'])}"] if result.get("commit") else []
    count, objects = result["num_examples"], result["num_objects"]
    parts.append(f"{count} examples of {objects} objects")
    if "accepted" in result:
        parts.append(f"adaptation accepted for {100 * result['accepted']:.0f} %")
    unit = f" Unit of length: {result['unit']}." if "unit" in result else ""
    return f"{', '.join(parts)}.{unit}"


def short(commit: str) -> str:
    """Twelve digits, and the mark of uncommitted changes if there is one."""
    return commit[:12] + commit[40:]


def _clouds(result: Mapping[str, Any]) -> list[str]:
    """The clouds that were scored, in the order of tables."""
    return [name for name in CLOUDS if name in result["clouds"]]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]
