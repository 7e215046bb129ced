"""Completions to look at, as the paper's figures 4 and 5 show them."""

import html
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from PIL import ImageColor
from scipy.spatial import KDTree

from experiments.protocol import Protocol, into_scored, observed, side_by_side
from experiments.scored_run import CompleteFn, Predictions, scored_clouds
from experiments.sheets import Color, Row, draw_clouds
from prism_jax.data.pipeline import with_partial
from prism_jax.data.source import Example, Source
from prism_jax.evaluation import metrics
from prism_jax.geometry.camera import Camera
from prism_jax.preprocessing.observation import Observation
from prism_jax.reporting.figures import (
    COMPLETED_COLOR,
    GROUND_TRUTH_COLOR,
    MAX_SHOWN_POINTS,
    OBSERVED_COLOR,
    Cloud,
    Panel,
    clouds_figure,
    subsample,
)
from prism_jax.reporting.view import viewing_direction

COLUMNS = (
    "Partial",
    "Completion: measured and added",
    "Ground truth",
    "Distance to the ground truth",
)
FAR = 0.1
"""The distance that has the last of `DISTANCE_COLORS`, in the points' unit."""

DISTANCE_COLORS = (
    (0.0, (0.16, 0.35, 0.6)),
    (0.35, (0.45, 0.75, 0.75)),
    (0.65, (0.96, 0.82, 0.4)),
    (1.0, (0.78, 0.16, 0.16)),
)
"""Shares of `FAR`, and their red, green and blue within 0 to 1."""

UP = np.array([0.0, 0.0, 1.0])
TURN = 75.0
"""Degrees from the sensor's view, so that both sides can be seen."""


class GalleryItem(NamedTuple):
    """One example, in the frame and unit of the scores.

    Attributes:
      name: of the example, after its category.
      measured: the partial as it was measured.
      added: what a user gets beside them.
      complete: the ground truth.
      errors: distance of every measured and then every added point to the nearest of
        the ground truth.
      before, after: CD-L2 of the partial, and with the added points.
      toward_viewer: a direction from the points.
    """

    name: str
    measured: Float[np.ndarray, "N 3"]
    added: Float[np.ndarray, "P 3"]
    complete: Float[np.ndarray, "M 3"]
    errors: Float[np.ndarray, " N+P"]
    before: float
    after: float
    toward_viewer: Float[np.ndarray, "3"]

    @property
    def completed(self) -> Float[np.ndarray, "_ 3"]:
        """The measured points, and then the added ones."""
        return np.concatenate([self.measured, self.added])

    @property
    def label(self) -> str:
        before, after = 1e4 * self.before, 1e4 * self.after
        return f"{self.name}: CD-L2 x1e4 {before:.4g}, completed {after:.4g}"


def complete_items(
    complete_fn: CompleteFn, source: Source, indices: Sequence[int], protocol: Protocol
) -> list[GalleryItem]:
    """The examples of these indices, completed as `evaluate` completes them."""
    examples = [with_partial(source[index]) for index in indices]
    seen = [observed(example, protocol) for example in examples]
    outputs = np.asarray(complete_fn(*side_by_side(seen)).network)
    rows = zip(examples, seen, map(Predictions, outputs), strict=True)
    return [_item(*row, protocol) for row in rows]


def _item(
    example: Example,
    seen: Observation,
    output: Predictions,
    protocol: Protocol,
) -> GalleryItem:
    assert example.complete is not None
    scaled, _ = into_scored(example, protocol)
    complete = scaled(example.complete)
    clouds = scored_clouds(example, np.asarray(seen.partial), output, protocol)
    measured, cloud = clouds["partial"], clouds["completed"]
    added = cloud[len(measured) :]
    errors = KDTree(complete).query(cloud)[0]
    return GalleryItem(
        f"{example.category.replace('_', ' ')} {example.name}",
        measured,
        added,
        complete,
        errors,
        _chamfer(errors[: len(measured)], measured, complete),
        _chamfer(errors, cloud, complete),
        viewing_direction(seen.camera, turn_degrees=TURN),
    )


def _chamfer(errors: np.ndarray, cloud: np.ndarray, complete: np.ndarray) -> float:
    return metrics.from_distances(errors, KDTree(cloud).query(complete)[0]).cd_l2


def picture_row(shown: GalleryItem, size: int) -> Row:
    """Four square pictures, in the order of `COLUMNS`, all from one side."""
    everything = np.concatenate([shown.complete, shown.completed])
    center = (everything.min(0) + everything.max(0)) / 2
    eye = center + 4.0 * np.ptp(everything, axis=0).max() * shown.toward_viewer
    camera = Camera.framing(jnp.asarray(everything), eye, 1.05, size, size)
    measured = shown.measured, rgb_of(OBSERVED_COLOR)
    pictures = (
        [measured],
        [(shown.added, rgb_of(COMPLETED_COLOR)), measured],
        [(shown.complete, rgb_of(GROUND_TRUTH_COLOR))],
        [(shown.completed, distance_colors(shown.errors))],
    )
    return Row(shown.label, [draw_clouds(clouds, camera) for clouds in pictures])


def rgb_of(css: str) -> Color:
    """A colour of CSS as red, green and blue within 0 to 1."""
    red, green, blue = ImageColor.getrgb(css)[:3]
    return red / 255, green / 255, blue / 255


def distance_colors(
    distances: Float[np.ndarray, " N"],
) -> Float[np.ndarray, "N 3"]:
    """`DISTANCE_COLORS` of each distance, as red, green and blue within 0 to 1."""
    shares, colors = zip(*DISTANCE_COLORS, strict=True)
    share = np.clip(distances / FAR, 0, 1)
    channels = np.array(colors).T
    return np.stack([np.interp(share, shares, c) for c in channels], -1)


def gallery_page(shown: Sequence[GalleryItem], caption: str) -> str:
    """All examples in 3-D, one at a time, as HTML that needs no network.

    A menu chooses the example: its clouds, its box and its direction.
    """
    figures = [_figure(item) for item in shown]
    owners = [i for i, figure in enumerate(figures) for _ in figure.data]
    page, *others = figures
    for other in others:
        page.add_traces(other.update_traces(visible=False).data)
    scenes = [f"scene{i}" if i > 1 else "scene" for i in range(1, len(COLUMNS) + 1)]
    buttons = [
        {
            "label": f"{i + 1}. {item.label}",
            "method": "update",
            "args": [
                {"visible": [owner == i for owner in owners]},
                {scene: figure.layout[scene].to_plotly_json() for scene in scenes},
            ],
        }
        for i, (item, figure) in enumerate(zip(shown, figures, strict=True))
    ]
    menu = {"buttons": buttons, "x": 0, "xanchor": "left", "y": 1.2, "yanchor": "top"}
    scale = [
        [share, "rgb({}, {}, {})".format(*(round(255 * channel) for channel in color))]
        for share, color in DISTANCE_COLORS
    ]
    bar = {"title": {"text": "distance"}, "thickness": 14, "len": 0.8}
    page.update_coloraxes(colorscale=scale, cmin=0, cmax=FAR, colorbar=bar)
    page.update_layout(
        title={"text": html.escape(caption), "font": {"size": 13}, "x": 0.01},
        updatemenus=[menu] if others else [],
        height=640,
        margin={"t": 104},
    )
    return page.to_html(
        config={"displaylogo": False, "responsive": True}, default_height="100%"
    )


def _figure(shown: GalleryItem) -> go.Figure:
    measured = Cloud("measured", shown.measured, OBSERVED_COLOR)
    added = Cloud("added", shown.added, COMPLETED_COLOR)
    truth = Cloud("ground truth", shown.complete, GROUND_TRUTH_COLOR)
    errors = Cloud("distance", shown.completed, COMPLETED_COLOR)
    clouds = ([measured], [measured, added], [truth], [errors])
    panels = [Panel(t, c) for t, c in zip(COLUMNS, clouds, strict=True)]
    figure = clouds_figure(panels, shown.toward_viewer, UP)
    distances = subsample(shown.errors, MAX_SHOWN_POINTS).astype(np.float32)
    figure.update_traces(
        marker={"color": distances, "coloraxis": "coloraxis"},
        showlegend=False,
        selector={"name": errors.name},
    )
    return figure
