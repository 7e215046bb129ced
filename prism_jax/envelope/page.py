"""The page that shows an envelope."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.envelope.distance import Envelope
from prism_jax.envelope.voxels import STATES, UNSEEN
from prism_jax.geometry.camera import Camera
from prism_jax.io import ply
from prism_jax.reporting.details import number
from prism_jax.reporting.figures import MAX_SHOWN_POINTS, Cloud, Panel, clouds_figure
from prism_jax.reporting.page import clouds_html, render
from prism_jax.reporting.view import viewing_direction

COLORS = {
    "measured": ply.COLORS[ply.OBSERVED],
    "robot": ply.COLORS[ply.KNOWN],
    "part": ply.COLORS[ply.KNOWN],
    "predicted": ply.COLORS[ply.COMPLETED],
    "unseen": (178, 186, 196),
    "free": (255, 255, 255),
}
"""Red, green, blue of each state."""


def envelope_page(
    envelope: Envelope,
    summary: Mapping[str, Any],
    camera: Camera | None,
    up: Float[np.ndarray, "3"],
) -> str:
    """HTML that needs no network, about 5 MB: surfaces beside the envelope's voxels.

    ``summary`` is the content of envelope.json, so that the two never disagree.
    """
    css = {name: "rgb({}, {}, {})".format(*rgb) for name, rgb in COLORS.items()}
    surfaces, voxels = envelope.surfaces.points, {}
    state, taken = envelope.state.ravel(), envelope.taken.ravel()
    for value, name in enumerate(STATES[: UNSEEN + 1]):
        shown = np.nonzero((state == value) & (taken | (value < UNSEEN)))[0]
        voxels[name] = envelope.grid.middles(shown)
    about = "Envelope: not free, and within q of a surface. White may be unseen"
    panels, names = [], set()
    for title, clouds in (("Surfaces", surfaces), (about, voxels)):
        there = {name: points for name, points in clouds.items() if len(points)}
        own = [Cloud(n, p, css[n], {"cloud": n}) for n, p in there.items()]
        panels.append(Panel(title, own))
        names.update(there)
    toward = np.array([0.7, 0.5, 0.5])
    if camera is not None:
        toward = viewing_direction(camera, up)
    bounds = np.stack([envelope.grid.lower, envelope.grid.upper])
    figure = clouds_figure(panels, toward, up, bounds)
    volumes, num_cells = summary["volumes"].items(), summary["calibration"]["n"]
    margin = f"q = {number(summary['q'])} m"
    if summary["part_margin"] is not None:
        margin += f", the known part's by {number(summary['part_margin'])} m at most"
    promise = (
        f"Surfaces are inflated by {margin}, calibrated on "
        f"{num_cells} cells: of another cell of the same population, the inflated "
        "surfaces hold all of what the recordings call the true surface with a "
        f"probability of at least {100 * (1 - summary['alpha']):.3g} %. Other cells "
        "have no such guarantee."
    )
    return render(
        "envelope.html",
        summary=summary,
        promise=promise,
        toggles=[pair for pair in css.items() if pair[0] in names],
        clouds=clouds_html(figure),
        max_shown=f"{MAX_SHOWN_POINTS:,}",
        volumes=[(k.replace("_", " "), f"{number(v)} m3") for k, v in volumes],
        details=_details(summary),
    )


def told(numbers: Mapping[str, Any]) -> str:
    """Numbers by their names, in words."""
    shown = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in numbers.items()}
    return ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in shown.items())


def _details(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    grid, calibration = summary["grid"], summary["calibration"]
    lower = ", ".join(f"{value:.6g}" for value in grid["lower"])
    frame = summary["input"].get("frame")
    source = summary["input"]["file"] + ("" if frame is None else f", frame {frame}")
    rows = [
        ("Input", source),
        ("Weights", summary["weights"]),
        ("Sensor", summary["sensor"]),
        ("Calibration", f"{calibration['file']}, {calibration['n']} cells"),
        ("Grid", f"{grid['shape']} voxels of {number(grid['voxel'])} m from ({lower})"),
        ("Points", ", ".join(f"{n:,} {k}" for k, n in summary["points"].items())),
        ("Seconds", ", ".join(f"{k} {v:.2f}" for k, v in summary["seconds"].items())),
        ("Software", f"prism_jax {summary['prism_jax'] or '(not installed)'}"),
    ]
    if summary["not_completed"]:
        rows.insert(1, ("Not completed", summary["not_completed"]))
    if summary["reference"]:
        rows.append(("Reference", told(summary["reference"])))
    if summary["query"]:
        rows.append(("Query (m)", told(summary["query"])))
    return rows
