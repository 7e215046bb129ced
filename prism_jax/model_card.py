"""What is known of released weights, as a page to read."""

from collections.abc import Iterator, Mapping
from typing import Any

import jax

from prism_jax.data.datasets import mesh_licences
from prism_jax.evaluation.tables import markdown, short
from prism_jax.weights import (
    load_pretrained,
    read_metadata,
    samples_seen,
    trainings,
)

WORST = 3
"""Kinds that are named of each data set, the ones with the highest CD-L2."""


def model_card(name_or_path: str) -> str:
    """Markdown: sizes, data with the licences of their meshes, samples, scores with
    intervals, what the weights are worst at, and notes.

    All of it from the weights' file. What `load_pretrained` refuses raises InputError.
    """
    config, variables = load_pretrained(name_or_path)
    about = read_metadata(name_or_path)
    backbone = config.model.backbone
    count = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
    sizes = f"{backbone.num_points:,} points in, {backbone.stage_sizes[-1]:,} out"
    adapting = f"adapts to a frame in K = {config.adapt.num_steps}"
    lines = [
        f"# {name_or_path}\n",
        f"{sizes}; {count:,} parameters; {adapting}.\n",
        *(f"- {line}" for line in _trainings(about)),
    ]
    scores = about.get("scores", {})
    for result in scores.values():
        lines += [f"\n{markdown(result)}", _worst(result)]
    if not scores:
        lines.append("\nNo scores.")
    lines += [f"\n{note}" for note in about.get("notes", [])]
    return "\n".join(lines) + "\n"


def _trainings(about: Mapping[str, Any]) -> Iterator[str]:
    """One line for each training, the first one first, then the meshes."""
    sets = {}
    for run in trainings(about):
        samples, data = run.get("samples", 0), run.get("data", "unknown")
        sets |= dict.fromkeys(data.split(", "))
        made = f"preset {run.get('preset')}, seed {run.get('seed')}"
        where = f"commit {short(run.get('commit') or 'unknown')}"
        yield f"{samples:,} samples of {data}, {made}, {where}"
    yield f"{samples_seen(about):,} samples in all"
    yield from (f"meshes of {name}: {mesh_licences(name)}" for name in sets)


def _worst(result: Mapping[str, Any]) -> str:
    """Where the measured points and what was added to them are farthest off."""
    kinds = result["merged"]["per_category"]
    worst = sorted(kinds, key=lambda kind: kinds[kind]["cd_l2"], reverse=True)
    told = (f"{kind} ({1e4 * kinds[kind]['cd_l2']:.4g})" for kind in worst[:WORST])
    return f"Worst at, CD-L2 x1e4 with the measured points kept: {', '.join(told)}."
