"""What a report says beside its verdict, in words and rows of tables."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

LEFT_AWAY = {
    "outside": "outside the workspace",
    "stray": "outliers",
    "in_front": "in front of measured points",
    "looked_through": "in space that the sensor saw through",
    "known": "where points were measured",
}
"""Why predicted points are not among the added ones."""

SENSOR = {
    "given": "given",
    "origin": "assumed at the origin",
    "unknown": "estimated from the points, as the origin is implausible",
}
"""Where the view of the depths is from."""

UP_SOURCE = {
    "given": "given",
    "support": "the normal of the support plane",
    "camera": "from the camera's orientation",
    "z": "the default",
}


def number(value: float | None) -> str:
    """Four digits of it; what is not finite is null in result.json."""
    return "not finite" if value is None else f"{value:.4g}"


def counts(points: Mapping[str, int]) -> str:
    """How many points there are of which kind."""
    added = points["completed"] - points["partial"]
    on_it = f", {points['support']:,} on the support" if "support" in points else ""
    return f"{points['partial']:,} points observed, {added:,} added{on_it}"


def adaptation(entry: Mapping[str, Any], asked: bool) -> str:
    """What became of the adaptation to one object."""
    objective = entry["losses"].get("objective")
    if not objective:
        why = ": these weights use no adaptation steps" if asked else ""
        return f"off{why}"
    first, last = number(objective[0]), number(objective[-1])
    steps = f"{len(objective) - 1} step{'s' if len(objective) != 2 else ''}"
    went = f"the objective changed from {first} to {last} in {steps}"
    if entry["accepted"]:
        return f"accepted: {went}. This does not mean that the completion is better"
    return f"rejected: {went}. The result is from the released network"


def left_away(entry: Mapping[str, Any]) -> str:
    """How many predicted points were not added, and why."""
    told = [
        f"{count:,} {LEFT_AWAY.get(reason, reason)}"
        for reason, count in entry["left_away"].items()
        if count
    ]
    return ", ".join(told) or "none"


def workspace(entry: Mapping[str, Any]) -> str:
    """The cube that was completed."""
    cube = entry["workspace"]
    center = _vector(cube["center"], cube["half_extent"])
    return f"cube centred at ({center}), half extent {number(cube['half_extent'])}"


def sigma(entry: Mapping[str, Any]) -> str:
    """How far single added points are expected to be off."""
    told = entry.get("sigma")
    if told is None:
        return "unknown: no points were added, or these weights do not estimate it"
    low, middle, high = (number(told[name]) for name in ("q05", "median", "q95"))
    spread = f"median {middle}, 5th to 95th percentile {low} to {high}"
    return f"{spread}, of the added points, in input units"


def known(entry: Mapping[str, Any]) -> str:
    """Which model an object is, and why it is no other."""
    refused = [f"{name}: {why}" for name, why in entry["refused"].items()]
    rest = f"; not {', '.join(refused[:20])}" if refused else ""
    if len(refused) > 20:
        rest += f" and {len(refused) - 20} more (result.json)"
    if entry["model"] is None:
        return f"none{rest}"
    names = " or ".join([entry["model"], *entry["equal"]])
    return f"{names}, which explains {entry['fit']:.0%} of its points{rest}"


def evidence(entry: Mapping[str, Any]) -> str:
    """The numbers that the verdict rests on."""
    if entry["verdict"] is None:
        return "none: these weights have no calibration"
    numbers = entry["verdict"]["evidence"].items()
    return ", ".join(f"{k.replace('_', ' ')} {number(v)}" for k, v in numbers)


def of_object(entry: Mapping[str, Any], adapt: bool) -> list[tuple[str, str]]:
    """Rows of a name and a text for an object in a scene."""
    rows = [("Known model", known(entry["known"]))] if "known" in entry else []
    return [
        ("Workspace", workspace(entry)),
        ("Adaptation", adaptation(entry, adapt)),
        ("Not added", left_away(entry)),
        ("Expected error of a point", sigma(entry)),
        ("Evidence", evidence(entry)),
        *rows,
    ]


def of_scan(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Rows of a name and a text for one object."""
    camera, points = summary["camera"], summary["points"]
    rotation, translation = map(np.array, (camera["rotation"], camera["translation"]))
    position = _vector(-translation @ rotation, summary["workspace"]["half_extent"])
    view = (
        f"{camera['width']} x {camera['height']} pixels, "
        f"{SENSOR[summary['sensor']]}, centre at ({position})"
    )
    left_out = f" and {summary['input']['points_left_out']:,} removed as outliers"
    cube, adapted, *others = of_object(summary, summary["adapt"])
    rows = [
        *_of_input(summary, left_out),
        ("Up", _up(summary["up"])),
        cube,
        ("Camera", view),
        adapted,
        ("Network output", f"{points['network']:,} points"),
        *others,
    ]
    if summary["ground_truth"]:
        truth = summary["ground_truth"]
        rows.append(("Ground truth", f"{truth['file']}, {truth['points']:,} points"))
    return [*rows, *_of_run(summary)]


def of_scene(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Rows of a name and a text for what a scene's objects share."""
    support, rest = summary["points"]["support"], summary["points"]["left_over"]
    return [
        *_of_input(summary),
        ("Support", f"{support:,} points on support planes and walls"),
        ("Left over", f"{rest:,} points in no object, or in one that is too small"),
        ("Up", f"{_up(summary['up'])}, {UP_SOURCE[summary['up_source']]}"),
        *_of_run(summary),
    ]


def _of_input(summary: Mapping[str, Any], more: str = "") -> list[tuple[str, str]]:
    source = summary["input"]
    outside = f"{source['points_outside']:,} outside the workspace"
    joint = ", " if more else " and "
    read = (
        f"{source['points_read']:,}, of which {source['points_not_finite']:,} not "
        f"finite{joint}{outside}{more}"
    )
    return [
        ("Input", source["file"]),
        ("Points read", read),
        ("Weights", summary["weights"]),
    ]


def _of_run(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    seconds = summary["seconds"].items()
    return [
        ("Density", f"{number(summary['density'])} times that of measured points"),
        ("Seconds", ", ".join(f"{name} {value:.2f}" for name, value in seconds)),
        ("Software", f"prism_jax {summary['prism_jax']}"),
    ]


def _up(up: Any) -> str:
    return up if isinstance(up, str) else f"({', '.join(f'{v:.3f}' for v in up)})"


def _vector(values: Any, length: float) -> str:
    """Coordinates with the decimals that matter to something of this length."""
    decimals = max(0, 3 - math.floor(math.log10(length)))
    return ", ".join(f"{value:,.{decimals}f}" for value in values)
