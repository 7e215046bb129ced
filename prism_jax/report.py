"""The HTML report of a completion: one file that needs no network."""

import html
import math
import string
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Bool, Float
from plotly.offline import get_plotlyjs

from prism_jax.assets import asset
from prism_jax.figures import (
    COMPLETED_COLOR,
    GROUND_TRUTH_COLOR,
    MAX_SHOWN_POINTS,
    OBSERVED_COLOR,
    Cloud,
    Panel,
    clouds_figure,
    depth_figure,
    losses_figure,
)
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.workspace import Workspace

SCORES = {
    "cd_l1": ("CD-L1 &times; 10<sup>3</sup>", 1e3, "lower is better"),
    "cd_l2": ("CD-L2 &times; 10<sup>4</sup>", 1e4, "lower is better"),
    "f_score": ("F-score at 1 %", 1.0, "higher is better"),
    "hausdorff": ("Hausdorff &times; 10", 10.0, "lower is better"),
}
"""How the table of scores shows each metric: title (HTML), factor, direction."""

CLOUDS = {
    "partial": "the measured points",
    "network": "all that the network predicts",
    "completed": "what you get: observed and added points",
}
"""What the clouds of a result are."""

_SENSOR = {
    "given": "given",
    "origin": "placed at the origin",
    "unknown": "placed by the program: the origin is too far away, or among the points",
}
"""Where the view of the depths is from."""

_CLOUD_BUTTONS = [["orbitRotation", "pan3d", "resetCameraDefault3d", "toImage"]]


@runtime_checkable
class Completed(Protocol):
    """What the report shows of a completion; see `prism_jax.completion`."""

    points: Float[np.ndarray, "M 3"]
    observed: Bool[np.ndarray, " M"]
    workspace: Workspace
    camera: Camera
    depth_observed: Float[np.ndarray, "H W"]
    mask_observed: Bool[np.ndarray, "H W"]
    depth_completed: Float[np.ndarray, "H W"]
    mask_completed: Bool[np.ndarray, "H W"]


def render_report(
    result: Completed,
    summary: Mapping[str, Any],
    ground_truth: Float[np.ndarray, "G 3"] | None = None,
) -> str:
    """The report as HTML with its scripts inlined, about 6 MB.

    `summary` is the content of `result.json`, so that the two never disagree; clouds
    are in the user's units and frame. Large clouds are thinned for display alone.
    """
    toward_viewer, up = viewing_direction(result.camera, summary["up"])
    clouds = clouds_figure(_panels(result, ground_truth), toward_viewer, up)
    depth = depth_figure(
        ("Partial scan", "Completion"),
        [np.asarray(result.depth_observed), np.asarray(result.depth_completed)],
        [np.asarray(result.mask_observed), np.asarray(result.mask_completed)],
    )
    template = asset("report.html")
    return string.Template(template.read_text(encoding="utf-8")).substitute(
        title=html.escape(f"{summary['input']['file']} completed by prism_jax"),
        plotly=get_plotlyjs(),
        file=html.escape(str(summary["input"]["file"])),
        verdict=_verdict(summary),
        cards=_cards(summary),
        clouds=_figure(clouds, "clouds", modeBarButtons=_CLOUD_BUTTONS),
        max_shown=f"{MAX_SHOWN_POINTS:,}",
        depth=_figure(depth, "depth", displayModeBar=False),
        losses=_losses(summary),
        scores=_scores(summary["scores"]),
        details=_table(_details(summary)),
    )


def viewing_direction(
    camera: Camera, axis_up: str = "z", turn_degrees: float = 35.0
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Toward the viewer, and up: as the camera saw it, turned and raised 20 degrees.

    Unit vectors in the points' frame; `axis_up` is one of x, y, z, -x, -y, -z. Looking
    from where the sensor stood would hide depth; from elsewhere, what it saw.
    """
    sign = -1.0 if axis_up.startswith("-") else 1.0
    up = sign * np.eye(3)["xyz".index(axis_up[-1])]
    toward = -np.asarray(camera.rotation, dtype=np.float64)[2]
    level = toward - (toward @ up) * up
    if np.linalg.norm(level) < 0.1:
        level = np.roll(up, 1)
    level = level / np.linalg.norm(level)
    turn, rise = np.deg2rad(turn_degrees), np.deg2rad(20.0)
    level = np.cos(turn) * level + np.sin(turn) * np.cross(up, level)
    return np.cos(rise) * level + np.sin(rise) * up, up


def _panels(result: Completed, ground_truth: np.ndarray | None) -> list[Panel]:
    observed = result.points[result.observed]
    completed = result.points[~result.observed]
    seen = Cloud("observed", observed, OBSERVED_COLOR)
    added = Cloud("completed", completed, COMPLETED_COLOR)
    panels = [
        Panel(f"Partial scan: {len(observed):,} points", [seen]),
        Panel(f"Completion: {len(result.points):,} points", [seen, added]),
    ]
    if ground_truth is not None:
        truth = Cloud("ground truth", ground_truth, GROUND_TRUTH_COLOR)
        panels.append(Panel(f"Ground truth: {len(ground_truth):,} points", [truth]))
    return panels


def _verdict(summary: Mapping[str, Any]) -> str:
    objective = summary["losses"].get("objective") or [None]
    first, last = _number(objective[0]), _number(objective[-1])
    steps = f"{len(objective) - 1} step{'s' if len(objective) != 2 else ''}"
    if len(objective) == 1:
        why = "of which these weights take no step" if summary["adapt"] else "as asked"
        kind, text = "off", f"Completed without test-time adaptation, {why}."
    elif summary["accepted"]:
        kind = "good"
        text = (
            f"Adaptation accepted: the objective went from {first} to {last} in "
            f"{steps}."
        )
    else:
        kind = "poor"
        text = (
            f"Adaptation not accepted: the objective went from {first} to {last} in "
            f"{steps}. This is the completion of the network as released."
        )
    return f'<p class="verdict {kind}">{html.escape(text)}</p>'


def _cards(summary: Mapping[str, Any]) -> str:
    points, seconds = summary["points"], summary["seconds"]
    cards = [
        ("points observed", f"{points['partial']:,}"),
        ("points added", f"{points['completed'] - points['partial']:,}"),
        *[
            (f"seconds to {name}", f"{seconds[name]:.1f}")
            for name in ("compile", "run")
            if seconds.get(name) is not None
        ],
        ("weights", str(summary["weights"])),
    ]
    return "".join(
        f"<div><b>{html.escape(value)}</b><span>{html.escape(name)}</span></div>"
        for name, value in cards
    )


def _losses(summary: Mapping[str, Any]) -> str:
    losses = {
        name.replace("_", " "): [np.nan if v is None else v for v in values]
        for name, values in summary["losses"].items()
    }
    if not losses:
        return "<p>None were computed.</p>"
    weights = ", ".join(
        f"{name} {_number(value)}" for name, value in summary["loss_weights"].items()
    )
    caption = "Step 0 is the network as released."
    if weights:
        caption += f" Weights in the objective: {weights}."
    figure = _figure(losses_figure(losses), "losses", displayModeBar=False)
    return f'{figure}<p class="caption">{html.escape(caption)}</p>'


def _scores(scores: Mapping[str, Any] | None) -> str:
    if scores is None:
        return "<p>No ground truth was given, so there is nothing to score against.</p>"
    head = "".join(
        f"<th>{title}<small>{direction}</small></th>"
        for title, _, direction in SCORES.values()
    )
    body = "".join(
        f"<tr><th>{name}<small>{CLOUDS[name]}</small></th>"
        + "".join(
            f"<td>{cloud[metric] * factor:.4g}</td>"
            for metric, (_, factor, _) in SCORES.items()
        )
        + "</tr>"
        for name, cloud in scores["clouds"].items()
    )
    note = (
        f"Against the ground truth. Unit of length: {scores['unit']}, "
        f"{scores['unit_length']:.4g} of the input's."
    )
    return (
        f'<table class="scores"><thead><tr><td></td>{head}</tr></thead>'
        f'<tbody>{body}</tbody></table><p class="caption">{html.escape(note)}</p>'
    )


def _details(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    source, workspace = summary["input"], summary["workspace"]
    camera = summary["camera"]
    decimals = max(0, 3 - math.floor(math.log10(workspace["half_extent"])))
    center = ", ".join(f"{value:,.{decimals}f}" for value in workspace["center"])
    rotation, translation = map(np.array, (camera["rotation"], camera["translation"]))
    position = ", ".join(f"{value:,.{decimals}f}" for value in -translation @ rotation)
    view = (
        f"{camera['width']} x {camera['height']} pixels, "
        f"{_SENSOR[summary['sensor']]}, centre at ({position})"
    )
    read = (
        f"{source['points_read']:,}, of them {source['points_not_finite']:,} not "
        f"finite and {source['points_outside']:,} outside the workspace"
    )
    rows = [
        ("Input", source["file"]),
        ("Points read", read),
        ("Weights", summary["weights"]),
        (
            "Workspace",
            f"cube about ({center}), half extent {_number(workspace['half_extent'])}",
        ),
        ("Camera", view),
        ("Network output", f"{summary['points']['network']:,} points"),
    ]
    if summary["ground_truth"]:
        truth = summary["ground_truth"]
        rows.append(("Ground truth", f"{truth['file']}, {truth['points']:,} points"))
    seconds = summary["seconds"].items()
    rows.append(("Seconds", ", ".join(f"{k} {v:.2f}" for k, v in seconds)))
    rows.append(("Software", f"prism_jax {summary['prism_jax']}"))
    return rows


def _table(rows: Sequence[tuple[str, Any]]) -> str:
    cells = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>"
        for name, value in rows
    )
    return f'<table class="details">{cells}</table>'


def _number(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.4g}"


def _figure(figure: go.Figure, name: str, **config: Any) -> str:
    return figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=name,
        config={"displaylogo": False, "responsive": True, **config},
    )
