"""The report of one completed object."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.completion.assembly import CompletedScan
from prism_jax.reporting import figures
from prism_jax.reporting.confidence import verdict_of_scan
from prism_jax.reporting.details import counts, of_scan
from prism_jax.reporting.page import chart_html, clouds_html, render
from prism_jax.reporting.view import shown_bounds, viewing_direction


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
    whole = figures.of_object(result)
    seen = whole[0]._replace(meta={**whole[0].meta, "cloud": ""})
    panels = [
        figures.Panel(f"Partial scan: {len(measured):,} points", [seen]),
        figures.Panel(f"Completion: {len(result.points):,} points", whole),
    ]
    if ground_truth is not None:
        color = figures.GROUND_TRUTH_COLOR
        meta = {"cloud": "", "color": {"": color, "error": color}}
        truth = figures.Cloud("ground truth", ground_truth, color, meta)
        title = f"Ground truth: {len(ground_truth):,} points"
        panels.append(figures.Panel(title, [truth]))
    toward = viewing_direction(result.camera, up)
    bounds = shown_bounds(measured, added, result.workspace)
    clouds: Any = figures.clouds_figure(panels, toward, up, bounds)
    modes = figures.tell_errors(clouds, result.sigma)
    depth = figures.depth_figure(
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
        toggles=[(cloud.name, cloud.color) for cloud in whole[:2]],
        modes=modes,
        clouds=clouds_html(clouds),
        objects=None,
        max_shown=f"{figures.MAX_SHOWN_POINTS:,}",
        depth=chart_html(depth, "depth"),
        losses=chart_html(figures.losses_figure(losses), "losses") if losses else "",
        details=of_scan(summary),
    )
