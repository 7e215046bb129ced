"""The HTML report of a completion: one file that needs no network."""

import math
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import jinja2
import numpy as np
import plotly.graph_objects as go
from jaxtyping import Bool, Float
from plotly.offline import get_plotlyjs

from prism_jax.assets import asset
from prism_jax.completed import CompletedScene
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

METRICS = (
    {"key": "cd_l1", "title": "CD-L1 x1e3", "factor": 1e3, "better": "lower"},
    {"key": "cd_l2", "title": "CD-L2 x1e4", "factor": 1e4, "better": "lower"},
    {"key": "f_score", "title": "F@0.01", "factor": 1.0, "better": "higher"},
    {"key": "hausdorff", "title": "HD x1e2", "factor": 1e2, "better": "lower"},
)
"""How the table of scores shows each metric."""

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
    toward_viewer, up = viewing_direction(result.camera, result.workspace.up)
    clouds = clouds_figure(_panels(result, ground_truth), toward_viewer, up)
    depth = depth_figure(
        ("Partial scan", "Completion"),
        [np.asarray(result.depth_observed), np.asarray(result.depth_completed)],
        [np.asarray(result.mask_observed), np.asarray(result.mask_completed)],
    )
    return _page().render(
        summary=summary,
        plotly=get_plotlyjs(),
        verdict=_verdict(summary),
        cards=_cards(summary),
        clouds=_figure(clouds, "clouds", modeBarButtons=_CLOUD_BUTTONS),
        max_shown=f"{MAX_SHOWN_POINTS:,}",
        depth=_figure(depth, "depth", displayModeBar=False),
        losses=_losses(summary),
        metrics=METRICS,
        cloud_names=CLOUDS,
        details=_details(summary),
    )


def render_scene_report(scene: CompletedScene, summary: Mapping[str, Any]) -> str:
    """The report of a scene: all of it in 3D, and a row for each object.

    `summary` is the content of `result.json`.
    """
    measured, added = scene.points[scene.observed], scene.points[~scene.observed]
    of_objects = scene.object[scene.observed] >= 0
    panel = Panel(
        f"{len(scene.objects)} objects",
        [
            Cloud("support and the rest", measured[~of_objects], GROUND_TRUTH_COLOR),
            Cloud("observed", measured[of_objects], OBSERVED_COLOR),
            Cloud("completed", added, COMPLETED_COLOR),
        ],
    )
    if scene.objects:
        toward = -np.asarray(scene.objects[0].camera.rotation, np.float64)[2]
    else:
        toward = np.asarray(scene.up)
    clouds = clouds_figure([panel], toward, np.asarray(scene.up))
    page = _page("scene.html")
    figure = _figure(clouds, "clouds", modeBarButtons=_CLOUD_BUTTONS)
    return page.render(summary=summary, plotly=get_plotlyjs(), clouds=figure)


def viewing_direction(
    camera: Camera,
    up: Float[np.ndarray, "3"] | None = None,
    turn_degrees: float = 35.0,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Toward the viewer, and up: as the camera saw it, turned and raised 20 degrees.

    Unit vectors in the points' frame, in which `up` is one, too: z if not given.
    Looking from where the sensor stood would hide depth; from elsewhere, what it saw.
    """
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    toward = -np.asarray(camera.rotation, dtype=np.float64)[2]
    level = toward - (toward @ up) * up
    if np.linalg.norm(level) < 0.1:
        across = np.eye(3)[np.abs(up).argmin()]
        level = across - (across @ up) * up
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


def _page(name: str = "report.html") -> jinja2.Template:
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["number"] = _number
    return environment.from_string(asset(name).read_text(encoding="utf-8"))


def _verdict(summary: Mapping[str, Any]) -> dict[str, str]:
    """What became of the adaptation, and the class that colours it."""
    objective = summary["losses"].get("objective") or [None]
    first, last = _number(objective[0]), _number(objective[-1])
    steps = f"{len(objective) - 1} step{'s' if len(objective) != 2 else ''}"
    went = f"the objective went from {first} to {last} in {steps}."
    if len(objective) == 1:
        why = "of which these weights take no step" if summary["adapt"] else "as asked"
        text = f"Completed without test-time adaptation, {why}."
        return {"kind": "off", "text": text}
    if summary["accepted"]:
        means = "This says that it did not rise, not that the completion is better."
        return {"kind": "good", "text": f"Adaptation accepted: {went} {means}"}
    means = "This is the completion of the network as released."
    return {"kind": "poor", "text": f"Adaptation not accepted: {went} {means}"}


def _cards(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    points, seconds = summary["points"], summary["seconds"]
    return [
        ("points observed", f"{points['partial']:,}"),
        ("points added", f"{points['completed'] - points['partial']:,}"),
        *[
            (f"seconds to {name}", f"{seconds[name]:.1f}")
            for name in ("compile", "run")
            if seconds.get(name) is not None
        ],
        ("weights", str(summary["weights"])),
    ]


def _losses(summary: Mapping[str, Any]) -> str:
    losses = {
        name.replace("_", " "): [np.nan if v is None else v for v in values]
        for name, values in summary["losses"].items()
    }
    if not losses:
        return ""
    return _figure(losses_figure(losses), "losses", displayModeBar=False)


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
        f"finite, {source['points_outside']:,} outside the workspace and "
        f"{source['points_left_out']:,} left out, far from all others"
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


def _number(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.4g}"


def _figure(figure: go.Figure, name: str, **config: Any) -> str:
    return figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=name,
        config={"displaylogo": False, "responsive": True, **config},
    )
