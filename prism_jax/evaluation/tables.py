"""Results as Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from prism_jax.evaluation.published import published_columns
from prism_jax.evaluation.summary import scores_of

ROWS = {
    "control": "partial itself",
    "unadapted": "network's output",
    "output": "network's output, adapted",
    "merged_unadapted": "measured points kept",
    "merged": "measured points kept, adapted",
}

_COLUMNS = {
    "cd_l2": ("CD-L2 x1e4", 1e4),
    "cd_l1": ("CD-L1 x1e3", 1e3),
    "f_score": ("F@0.01", 1.0),
    "emd": ("EMD x1e2", 1e2),
    "hd": ("HD x1e2", 1e2),
}


def markdown(result: Mapping[str, Any]) -> str:
    """What names the result, the means with their intervals, and CD-L2 by category."""
    labels = _labels(result)
    columns = {m: c for m, c in _COLUMNS.items() if m in result["mean"]}
    categories = list(result["per_category"])
    means, by_category = [], []
    for name, label in labels.items():
        scores = scores_of(result, name)
        cells = [
            _cell(scores["mean"][m], scores["intervals"][m], factor)
            for m, (_, factor) in columns.items()
        ]
        means.append([label, *cells])
        cells = [scores["per_category"][name]["cd_l2"] for name in categories]
        by_category.append([label, *(f"{1e4 * cell:.4g}" for cell in cells)])
    return "\n".join(
        [
            f"{_title(result)}\n",
            *_table(["", *(head for head, _ in columns.values())], means),
            "",
            *_table(["CD-L2 x1e4", *categories], by_category),
            "",
        ]
    )


def comparison_markdown(table: Mapping[str, Any]) -> str:
    """What names a `comparison`, and its rows."""
    rows, against = table["rows"], table["against"]
    metrics = next(iter(rows.values()))["mean"]
    columns = {m: c for m, c in _COLUMNS.items() if m in metrics}
    heads = [head for head, _ in columns.values()]
    counted = any(row["parameters"] for row in rows.values())
    lines = []
    for label, row in rows.items():
        cells = [
            _cell(row["mean"][m], row["intervals"][m], factor)
            for m, (_, factor) in columns.items()
        ]
        change = None if label == against else row["change"].get("cd_l2")
        cells.append(_percent(**change) if change else "")
        if counted:
            number = row["parameters"]
            cells.append(f"{number / 1e6:.2f} M" if number else "")
            cells.append(f"{row['samples']:,}" if row["samples"] else "")
        lines.append([label, *cells])
    head = ["", *heads, f"CD-L2 against {against}"]
    head += ["parameters", "samples"] if counted else []
    return "\n".join([f"{_title(table)}\n", *_table(head, lines), ""])


def agreement_markdown(result: Mapping[str, Any]) -> str:
    """What names the result of `agreement`, and its rows."""
    rows = []
    for label, row in result["losses"].items():
        low, high = row["interval"]
        mean = f"{row['mean']:+.3f} [{low:+.3f}, {high:+.3f}]"
        change = _percent(row["change"], row["change_interval"])
        rows.append([label, mean, f"{100 * row['positive']:.0f} %", change])
    head = ["gradient of", f"cosine with that of {result['error']}", "positive"]
    head.append(f"the error after a step of length {result['step_length']:g}")
    return "\n".join([f"{_title(result)}\n", *_table(head, rows), ""])


def _cell(mean: float, interval: Sequence[float], factor: float) -> str:
    low, high = (factor * bound for bound in interval)
    return f"{factor * mean:.4g} [{low:.4g}, {high:.4g}]"


def _percent(change: float, interval: Sequence[float]) -> str:
    low, high = (f"{100 * bound:+.1f}" for bound in interval)
    return f"{100 * change:+.1f} % [{low}, {high}]"


def published_markdown(dataset: str, result: Mapping[str, Any]) -> str:
    """What names the result, and the columns of the data set's published table."""
    columns = {
        label: published_columns(dataset, result, name)
        for name, label in _labels(result).items()
    }
    head = "CD-L1 x1e3" if dataset == "pcn" else "CD-L2 x1e3"
    rows = [
        [label, *(f"{value:.4g}" for value in row.values())]
        for label, row in columns.items()
    ]
    table = _table([head, *next(iter(columns.values()))], rows)
    return "\n".join([f"{_title(result)}\n", *table, ""])


def _title(result: Mapping[str, Any]) -> str:
    """One line of what the result was made from, as far as it says."""
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
    """Twelve digits, and whether its files were changed."""
    return commit[:12] + commit[40:]


def _labels(result: Mapping[str, Any]) -> dict[str, str]:
    """The clouds that were scored, in words; not adapted unless both are there."""
    there = [name for name in ROWS if name == "output" or name in result]
    suffix = "" if "unadapted" in there else ", adapted"
    return {name: ROWS[name].removesuffix(suffix) for name in there}


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]
