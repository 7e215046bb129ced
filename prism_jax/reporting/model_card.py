"""What is known of released weights, as a page to read."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax

from prism_jax.completion import weights
from prism_jax.data.datasets import mesh_licences
from prism_jax.evaluation.tables import markdown, short

WORST = 3
"""How many categories of each data set are named, those with the highest CD-L2."""


def model_card(name_or_path: str) -> str:
    """Markdown: sizes, data with the licences of their meshes, samples, scores with
    intervals, what the weights are worst at, and notes. All of it from the weights'
    file. What `load_pretrained` refuses raises InputError."""
    config, variables = weights.load_pretrained(name_or_path)
    about = weights.read_metadata(name_or_path)
    backbone = config.model.backbone
    count = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
    sizes = f"{backbone.num_points:,} points in, {config.model.num_points:,} out"
    if config.model.poses > 1:
        sizes += f", of {config.model.poses} poses"
    adapting = f"adapts to a frame in K = {config.adapt.num_steps}"
    lines = [
        f"# {name_or_path}\n",
        f"{sizes}; {count:,} parameters; {adapting}.\n",
        *(f"- {line}" for line in _trainings(about)),
    ]
    # By data set and split, without what `evaluate` holds of every example.
    scores = about.get("scores", {})
    for result in scores.values():
        lines += [f"\n{markdown(result)}", _worst(result)]
    if not scores:
        lines.append("\nNo scores.")
    lines += [f"\n{line}" for line in _trust(about)]
    notes = "\n\n".join(about.get("notes", [])).replace("experiments.md", "findings.md")
    lines += [f"\n{notes}"] if notes else []
    return "\n".join(lines) + "\n"


def weights_table(names: Sequence[str]) -> str:
    """A few lines on each of some weights: what they saw, and, on each split, how far
    from the truth the scan is and what a user gets of it, without adaptation."""
    rows = [("weights", "samples", "scored on", "the scan", "completed", "worst at")]
    for name in names:
        about = weights.read_metadata(name)
        told: Any = (name, f"{weights.samples_seen(about):,}")
        for split, result in about.get("scores", {}).items():
            clouds = result["clouds"]
            done = clouds.get("completed_unadapted", clouds["completed"])
            errors = (clouds["partial"]["mean"]["cd_l2"], done["mean"]["cd_l2"])
            scan, completed = (f"{1e4 * error:.4g}" for error in errors)
            rows.append((*told, split, scan, completed, _worst_of(done)[0]))
            told = ("", "")
        if told[0]:
            rows.append((*told, "nothing", "", "", ""))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True))
        for row in rows
    ]
    return "\n".join(line.rstrip() for line in lines)


def _trainings(about: Mapping[str, Any]) -> Iterator[str]:
    """One line for each training, the first one first, then the meshes."""
    sets = {}
    for run in weights.trainings(about):
        samples, data = run.get("samples", 0), run.get("data", "unknown")
        sets |= dict.fromkeys(data.split(", "))
        made = f"preset {run.get('preset')}, seed {run.get('seed')}"
        where = f"commit {short(run.get('commit') or 'unknown')}"
        between = run.get("interpolated")
        share = f", {between['share']:.0%} of what it changed kept" if between else ""
        yield f"{samples:,} samples of {data}, {made}, {where}{share}"
    yield f"{weights.samples_seen(about):,} samples in all"
    yield from (f"meshes of {name}: {mesh_licences(name)}" for name in sets)


def _trust(about: Mapping[str, Any]) -> Iterator[str]:
    """How far the verdicts on their completions are right, if there are any."""
    if "calibration" not in about:
        yield "No confidence: these weights have no calibration."
    elif "trust" in about:
        held_out = about["trust"]["all"]
        yield (
            f"Confidence, on {held_out['views']:,} shifted validation views: the rank "
            "correlation of expected and true error is "
            f"{held_out['rank_correlation']:.2f}; {held_out['worst_tenth_low']:.0%} of "
            f"the worst tenth and {held_out['better_half_low']:.0%} of the better half "
            "have low confidence."
        )
    if "point_errors" not in about:
        yield "No per-point errors: these weights do not estimate them."
    elif "sigma" in about:
        held_out = about["sigma"]["all"]
        yield (
            f"Per-point errors, on {held_out['views']:,} shifted validation views: the "
            "rank correlation with the true errors is "
            f"{held_out['rank_correlation']:.2f}; {held_out['below_one']:.0%} of the "
            f"errors are below 1 sigma, {held_out['below_two']:.0%} below 2 sigma."
        )


def _worst(result: Mapping[str, Any]) -> str:
    """The categories whose completed clouds are farthest off."""
    cloud = result["clouds"]["completed"]
    kinds, worst = cloud["per_category"], _worst_of(cloud)
    told = (f"{kind} ({1e4 * kinds[kind]['cd_l2']:.4g})" for kind in worst[:WORST])
    return f"Worst at, CD-L2 x1e4 of completed: {', '.join(told)}."


def _worst_of(cloud: Mapping[str, Any]) -> list[str]:
    """Categories by their CD-L2, the highest first."""
    kinds = cloud["per_category"]
    return sorted(kinds, key=lambda kind: kinds[kind]["cd_l2"], reverse=True)
