"""The report of one completed object."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.completion.assembly import CompletedScan
from prism_jax.reporting.confidence import verdict_of_scan
from prism_jax.reporting.details import counts, of_scan
from prism_jax.reporting.figures import (
    COMPLETED_COLOR,
    GROUND_TRUTH_COLOR,
    MAX_SHOWN_POINTS,
    OBSERVED_COLOR,
    Cloud,
    Panel,
    by_error,
    clouds_figure,
    depth_figure,
    losses_figure,
    tell_errors,
)
from prism_jax.reporting.page import chart_html, clouds_html, render
from prism_jax.reporting.view import shown_bounds, viewing_direction

METRICS = (
    {"key": "cd_l1", "title": "CD-L1 x1e3", "factor": 1e3, "better": "lower"},
    {"key": "cd_l2", "title": "CD-L2 x1e4", "factor": 1e4, "better": "lower"},
    {"key": "f_score", "title": "F@0.01", "factor": 1.0, "better": "higher"},
    {"key": "hausdorff", "title": "HD x1e2", "factor": 1e2, "better": "lower"},
)
"""How the table of scores shows each metric."""

CLOUDS = {
    "partial": "the measured points",
    "network": "all points that the network predicts",
    "completed": "the result: observed and added points",
}
"""What the clouds of a result are."""


def render_report(
    result: CompletedScan,
    summary: Mapping[str, Any],
    ground_truth: Float[np.ndarray, "G 3"] | None = None,
) -> str:
    """The report as HTML that needs no network, about 6 MB. `summary` is the content of
    `result.json`, so that the two never disagree; clouds are in the user's units and
    frame. Large clouds are thinned for display alone."""
    measured, added = result.points[result.observed], result.points[~result.observed]
    up = result.workspace.up
    seen = Cloud("observed", measured, OBSERVED_COLOR)
    predicted = Cloud("completed", added, COMPLETED_COLOR)
    panels = [
        Panel(f"Partial scan: {len(measured):,} points", [seen]),
        Panel(f"Completion: {len(result.points):,} points", [seen, predicted]),
    ]
    if ground_truth is not None:
        truth = Cloud("ground truth", ground_truth, GROUND_TRUTH_COLOR)
        panels.append(Panel(f"Ground truth: {len(ground_truth):,} points", [truth]))
    toward = viewing_direction(result.camera, up)
    bounds = shown_bounds(measured, added, result.workspace)
    clouds: Any = clouds_figure(panels, toward, up, bounds)
    modes = tell_errors(clouds, result.sigma)
    seen_by, predicted_by = (
        by_error(result.sigma, which) for which in (result.observed, ~result.observed)
    )
    about = (
        ("", OBSERVED_COLOR, seen_by),
        ("observed", OBSERVED_COLOR, seen_by),
        ("completed", COMPLETED_COLOR, predicted_by),
        ("", GROUND_TRUTH_COLOR, {"error": GROUND_TRUTH_COLOR}),
    )
    for trace, (cloud, color, by) in zip(clouds.data, about, strict=False):
        trace.meta = {"cloud": cloud, "color": {"": color, **by}}
    depth = depth_figure(
        ("Partial scan", "Completion"),
        [np.asarray(result.depth_observed), np.asarray(result.depth_completed)],
        [np.asarray(result.mask_observed), np.asarray(result.mask_completed)],
    )
    losses = {
        name.replace("_", " "): [np.nan if v is None else v for v in values]
        for name, values in summary["losses"].items()
    }
    return render(
        summary=summary,
        verdict=verdict_of_scan(summary, float(np.ptp(measured, axis=0).max())),
        counts=counts(summary["points"]),
        toggles=[("observed", OBSERVED_COLOR), ("completed", COMPLETED_COLOR)],
        modes=modes,
        clouds=clouds_html(clouds),
        objects=None,
        max_shown=f"{MAX_SHOWN_POINTS:,}",
        depth=chart_html(depth, "depth"),
        losses=chart_html(losses_figure(losses), "losses") if losses else "",
        metrics=METRICS,
        cloud_names=CLOUDS,
        details=of_scan(summary),
    )
