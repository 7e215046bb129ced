"""Results as Markdown."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from prism_jax.evaluation.scoring import CLOUDS


class Column(NamedTuple):
    """How a table shows a metric."""

    metric: str
    head: str
    factor: float


COLUMNS = (
    Column("cd_l2", "CD-L2 x1e4", 1e4),
    Column("cd_l1", "CD-L1 x1e3", 1e3),
    Column("f_2", "F at 2 %", 1.0),
    Column("precision_2", "precision at 2 %", 1.0),
    Column("recall_2", "recall at 2 %", 1.0),
    Column("emd", "EMD x1e2", 1e2),
    Column("hausdorff", "HD x1e2", 1e2),
    Column("f_score", "F@0.01", 1.0),
)
"""What says most comes first. Older results, without F at 2 %, show the last one."""
MEASURES = {
    "cd_l2": ("cd_l2", "mean", "CD-L2"),
    "cd_l1": ("cd_l1", "mean", "CD-L1"),
    "log_cd_l1": ("cd_l1", "log mean", "log CD-L1"),
    "precision_2": ("precision_2", "mean", "precision at 2 %"),
    "recall_2": ("recall_2", "mean", "recall at 2 %"),
    "f_2": ("f_2", "mean", "F at 2 %"),
}
"""What comparisons tell: a metric, what is taken of it over examples, and what tables
call that. The mean of CD-L2 hangs on a few bad examples: the others do so less."""


def markdown(result: Mapping[str, Any]) -> str:
    """What the result is of, the means with their intervals, CD-L2 by category, and
    what adaptation changes."""
    clouds = {name: result["clouds"][name] for name in clouds_of(result)}
    columns = columns_of(clouds.values())
    categories = list(clouds["network"]["per_category"])
    means, by_category = [], []
    for name, scores in clouds.items():
        means.append([name, *score_cells(scores, columns)])
        cells = [scores["per_category"][name]["cd_l2"] for name in categories]
        by_category.append([name, *(f"{1e4 * cell:.4g}" for cell in cells)])
    lines = [
        f"{title(result)}\n",
        *table_lines(["", *(column.head for column in columns)], means),
        "",
        *table_lines(["CD-L2 x1e4", *categories], by_category),
        "",
    ]
    changes = {
        f"{cloud}, {label}": found[measure]
        for cloud, found in result.get("adaptation", {}).items()
        for measure, (_, _, label) in MEASURES.items()
        if measure in found
    }
    if changes:
        heads, cells = change_cells(changes, "adaptation changes")
        rows = [[label, *row] for label, row in zip(changes, cells, strict=True)]
        lines += [*table_lines(["", *heads], rows), ""]
    return "\n".join(lines)


def columns_of(rows: Collection[Mapping[str, Any]], most: int = 7) -> list[Column]:
    """The first ones whose means are there, in any row."""
    there = [c for c in COLUMNS if any(c.metric in row["mean"] for row in rows)]
    return there[:most]


def score_cells(scores: Mapping[str, Any], columns: Sequence[Column]) -> list[str]:
    """The means of one cloud with their intervals, and the number of examples if some
    lack the metric."""
    cells = []
    for metric, _, factor in columns:
        cell = ""
        if metric in scores["mean"]:
            bounds = scores["mean"][metric], *scores["intervals"][metric]
            mean, low, high = (f"{factor * bound:.4g}" for bound in bounds)
            of = scores.get("of", {}).get(metric)
            cell = f"{mean} [{low}, {high}]{f' of {of}' if of else ''}"
        cells.append(cell)
    return cells


def change_cells(
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


def title(result: Mapping[str, Any]) -> str:
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


def clouds_of(result: Mapping[str, Any]) -> list[str]:
    """The clouds that were scored, in the order of tables."""
    return [name for name in CLOUDS if name in result["clouds"]]


def table_lines(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]
