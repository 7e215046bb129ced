"""The report of a completed scene: all its objects, together and one by one."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.completion.assembly import CompletedScene
from prism_jax.geometry.camera import Camera
from prism_jax.preprocessing.segmentation.scene import LEFT_OVER, SUPPORT
from prism_jax.reporting import details, figures
from prism_jax.reporting.confidence import (
    TRUST,
    TRUST_COLORS,
    trust_of,
    verdict_of_scene,
)
from prism_jax.reporting.page import clouds_html, render
from prism_jax.reporting.view import BULK, shown_bounds, viewing_direction

BESIDE_LIST = 0.7
"""The share of the page's width that the list of objects leaves to the clouds."""

ABOUT = 0.5
"""How far about the objects the support is shown, in the longest side of their box."""

MAX_SHOWN_IN_SCENE = 60_000
"""Observed points of all objects in a scene's figure, and as many added ones."""


def render_scene_report(scene: CompletedScene, summary: Mapping[str, Any]) -> str:
    """The report as HTML that needs no network, about 5 MB and the clouds. `summary` is
    the content of `result.json`, as for `render_report`. Large clouds are thinned for
    display alone, the more the more objects there are."""
    entries = summary["objects"]
    clouds = _clouds(scene, entries)
    bounds = _bounds(scene)
    along_x = Camera.look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    camera = scene.objects[0].camera if scene.objects else along_x
    up = np.asarray(scene.up, np.float64)
    toward = viewing_direction(camera, up, turn_degrees=20.0, rise_degrees=35.0)
    figure: Any = figures.clouds_figure([figures.Panel("", clouds)], toward, up, bounds)
    boxes = [
        shown_bounds(one.points[one.observed], one.points[~one.observed], one.workspace)
        for one in scene.objects
    ]
    for trace in figure.data:
        number = trace.meta["object"]
        around = bounds if number is None else boxes[number]
        shown = np.stack([trace.x, trace.y, trace.z], axis=1)
        size = figures.marker_size(shown, np.ptp(around, axis=0).max())
        sizes = [trace.marker.size, size] if "marker" in trace else [0, 0]
        trace.meta = {**trace.meta, "size": sizes}
    added = map(figures.added, scene.objects)
    shift = figures.axis_shift(bounds)
    layouts = [_layout(box, shift, toward, up) for box in [bounds, *boxes]]
    figure.update_scenes(camera=layouts[0]["scene.camera"])
    return render(
        summary=summary,
        verdict=verdict_of_scene(entries),
        counts=details.counts(summary["points"]),
        toggles=[
            ("observed", figures.OBSERVED_COLOR),
            *sorted({("completed", figures.COMPLETED_COLOR), *added}),
            ("support", figures.SUPPORT_COLOR),
            ("left over", figures.LEFT_OVER_COLOR),
        ],
        modes=["trust", *figures.tell_errors(figure, scene.sigma)],
        clouds=clouds_html(figure),
        trusts=[trust for trust in TRUST if trust in map(trust_of, entries)],
        objects=[_row(number, entry, summary) for number, entry in enumerate(entries)],
        boxes=layouts,
        max_shown=f"{_share(scene):,}",
        details=details.of_scene(summary),
    )


def _clouds(
    scene: CompletedScene, entries: Sequence[Mapping[str, Any]]
) -> list[figures.Cloud]:
    """Those that are of no object, and those of each."""
    clouds = []
    for number, name, color in (
        (SUPPORT, "support", figures.SUPPORT_COLOR),
        (LEFT_OVER, "left over", figures.LEFT_OVER_COLOR),
    ):
        colors = dict.fromkeys(["", "trust", "error"], color)
        meta = {"cloud": name, "object": None, "color": colors}
        points = scene.points[scene.object == number]
        clouds.append(figures.Cloud(name, points, color, meta))
    for number, (one, entry) in enumerate(zip(scene.objects, entries, strict=True)):
        shown = one, _share(scene), f"object {number}, "
        trust = {"trust": TRUST_COLORS[trust_of(entry)]}
        clouds += figures.of_object(*shown, object=number, color=trust)
    return clouds


def _share(scene: CompletedScene) -> int:
    """The most points of one cloud that are shown."""
    count = max(len(scene.objects), 1)
    return min(figures.MAX_SHOWN_POINTS, max(MAX_SHOWN_IN_SCENE // count, 200))


def _bounds(scene: CompletedScene) -> Float[np.ndarray, "2 3"]:
    """The box around what was measured of the objects, and of the bulk of the support
    what lies about them."""
    support = scene.points[scene.object == SUPPORT]
    if not scene.objects:
        all_there_is = support if len(support) else scene.points
        return np.quantile(all_there_is, BULK, axis=0).astype(np.float64)
    measured = [one.points[one.observed] for one in scene.objects]
    lower = np.min([cloud.min(axis=0) for cloud in measured], axis=0).astype(float)
    upper = np.max([cloud.max(axis=0) for cloud in measured], axis=0).astype(float)
    if len(support):
        about = ABOUT * (upper - lower).max()
        low, high = np.quantile(support, BULK, axis=0)
        lower = np.minimum(lower, np.maximum(low, lower - about))
        upper = np.maximum(upper, np.minimum(high, upper + about))
    return np.stack([lower, upper])


def _layout(
    bounds: np.ndarray, shift: np.ndarray, toward: np.ndarray, up: np.ndarray
) -> dict[str, Any]:
    """What Plotly has to change to show this box alone."""
    box = figures.axis_box(bounds - shift, shift)
    shown = {f"scene.{a}axis.range": box[f"{a}axis"]["range"] for a in "xyz"}
    shown["scene.aspectratio"] = box["aspectratio"]
    shown["scene.camera"] = figures.framing(
        box, toward, up, figures.PAGE_ASPECT * BESIDE_LIST
    )
    return shown


def _row(
    number: int, entry: Mapping[str, Any], summary: Mapping[str, Any]
) -> dict[str, Any]:
    """One object in the list, and what the details say of it."""
    points, verdict = entry["points"], entry["verdict"]
    error = None if verdict is None else verdict["expected_error"]
    reasons = [] if verdict is None else verdict["reasons"]
    known = entry.get("known", {}).get("model")
    if known:
        reasons = [f"known: {known}"]
    return {
        "number": number,
        "trust": trust_of(entry),
        "observed": f"{points['partial']:,}",
        "added": f"{points['completed'] - points['partial']:,}",
        "error": "-" if error is None else f"{error:#.3g}",
        "reasons": reasons,
        "known": known,
        "details": details.of_object(entry, summary["adapt"]),
    }
