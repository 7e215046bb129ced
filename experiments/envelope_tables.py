"""What `experiments.envelopes` found, in tables and in a sentence."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from prism_jax.envelope.calibration import coverage_interval

METHODS = {
    "measured": "everything measured",
    "completed": "everything measured, and predicted",
    "scaled": "the same, in scales of expected errors",
    "objects": "objects measured",
    "objects_completed": "objects measured, and predicted",
    "hull": "the convex hull of objects measured",
}
"""What a margin is laid around. A known robot is part of each."""

PAYS = 0.40
"""Metres: with a wider margin completion does not pay."""


def choices_markdown(result: Mapping[str, Any]) -> str:
    """The comparisons as tables."""
    lines = [
        f"{result['cells']} cells of validation; naive carving, by the pixel of a "
        f"voxel's middle, frees {100 * result['naive_freed']:.2f} % of the truly "
        "occupied voxels.\n",
        "| margin, m | share | occupied freed | but for measured ones | free |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in result["carving"]:
        lines.append(
            f"| {row['margin']:g} | {row['share']:g} | {row['occupied_freed']:.3%} | "
            f"{row['occupied_freed_without_measured']:.3%} | {row['free_share']:.1%} |"
        )
    lines.append("\n| robot known, completed is | median score, m | 90 % |")
    lines.append("| --- | --- | --- |")
    for name, scores in result["robot_known_scores"].items():
        median, high = np.quantile(scores, (0.5, 0.9))
        lines.append(f"| {name} | {median:.3f} | {high:.3f} |")
    return "\n".join(lines) + "\n"


def markdown(result: Mapping[str, Any]) -> str:
    """The tables, and whether completion pays."""
    lines = [
        f"weights {result['weights']} at K = 0, {result['num_cells']} cells to "
        f"calibrate and {result['num_cells']} to test, commit "
        f"{(result['commit'] or 'unknown')[:12]}. Volumes are means over cells of "
        f"voxels that are not free; intervals of 95 %.\n",
    ]
    titles = {
        "calibration": "Calibrated on other cells of the same arms",
        "other_arms": "Calibrated on cells of other arms",
    }
    for calibrated, title in titles.items():
        lines += [
            f"**{title}**\n",
            "| robot | margin around | wanted | q, m | coverage | volume, m3 | of all "
            "that is not free |",
            "| --- | --- | --- | --- | --- | --- | --- |",
        ]
        for robot, told in result["robot"].items():
            for row in told["rows"]:
                if row["calibrated_on"] == calibrated:
                    lines.append(f"| {robot} | {_row_markdown(row)} |")
            none, total = told["cells_with_none_freed"], told["cells"]["test"]
            low, high = coverage_interval(none, total)
            lines.append(
                f"| {robot} | all that is not free | - | - | "
                f"{none / total:.0%} [{low:.0%}, {high:.0%}] | "
                f"{told['unseen_volume']:.2f} | 100 % |"
            )
        lines.append("")
    lines += [
        "| robot | occupied voxels called free | of robot and fixtures | naively | "
        "query of both distances, ms | to get ready, ms |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for robot, told in result["robot"].items():
        counts, spent = told["occupied"], told["query_ms"]
        lines.append(
            f"| {robot} | {counts['all_freed'] / counts['all']:.3%} | "
            f"{counts['objects_freed'] / counts['objects']:.3%} | "
            f"{counts['all_freed_naively'] / counts['all']:.1%} | "
            f"{spent['median']:.1f}, at most {spent['largest']:.1f} for "
            f"{spent['points']:,} points | {spent['ready']:.0f} |"
        )
    lines.append("\n" + pays(result))
    return "\n".join(lines) + "\n"


def pays(result: Mapping[str, Any]) -> str:
    """The sentence that says whether completion pays, with the robot known."""
    rows = {
        row["method"]: row["q"]
        for row in result["robot"]["known"]["rows"]
        if row["calibrated_on"] == "calibration" and row["alpha"] == 0.1
    }
    q, alone = rows["completed"], rows["measured"]
    numbers = f"{q:.2f} m with completion and {alone:.2f} m without"
    if q > PAYS:
        return f"Completion does not pay there: with the robot known, q is {numbers}."
    return f"With the robot known, q is {numbers}."


def _row_markdown(row: Mapping[str, Any]) -> str:
    low, high = row["interval"]
    covered = row["covered"] / row["tested"]
    unit = " scales" if row["method"] == "scaled" else ""
    return (
        f"{METHODS[row['method']]} | {1 - row['alpha']:.0%} | {row['q']:.3f}{unit} | "
        f"{covered:.0%} [{low:.0%}, {high:.0%}] | {row['volume']:.2f} | "
        f"{row['share_of_unseen']:.0%}"
    )
