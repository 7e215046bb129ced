"""Plotly figures of a completion: clouds, depth maps and losses."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Bool, Float, Int
from plotly.subplots import make_subplots
from scipy.spatial import KDTree

from prism_jax.io.ply import COLORS, COMPLETED, KNOWN, OBSERVED

MAX_SHOWN_POINTS = 10_000
"""Of each cloud in a figure; a larger one is thinned, the same points every time."""

ERRORS_SHOWN = 0.95
"""The share of the added points with errors that colours tell apart; the rest have the
colour of the largest."""

PAGE_ASPECT = 2.1  # width to height of all panels together, about

SHOWN_PIXELS = 400
"""About the length, on a screen, of the longest side of what a panel shows."""

MAX_FACES = 20_000  # of a mesh that is drawn

MARKER_SIZES = (1.4, 4.0)  # the smallest and the largest diameter of a point, in pixels

OBSERVED_COLOR, COMPLETED_COLOR, KNOWN_COLOR = (
    "rgb({}, {}, {})".format(*COLORS[label]) for label in (OBSERVED, COMPLETED, KNOWN)
)
GROUND_TRUTH_COLOR = "rgb(96, 108, 118)"
SUPPORT_COLOR, LEFT_OVER_COLOR = "rgb(178, 186, 196)", "rgb(75, 85, 99)"
_FONT = {"family": "system-ui, Segoe UI, Helvetica, Arial, sans-serif", "size": 13}
_GRID = "#dfe3e8"
_LINE = "#8b949e"
_NO_DEPTH = "#d5d9df"
_AXIS = {"nticks": 4, "tickfont": {"size": 10, "color": "#6a737d"}, "gridcolor": _GRID}
_AXIS |= {"linecolor": _LINE, "showline": True, "mirror": True, "zeroline": False}
_AXIS |= {"backgroundcolor": "white", "showspikes": False}


class Cloud(NamedTuple):
    """Points of one colour in a panel."""

    name: str  # what the legend calls them
    points: Float[np.ndarray, "N 3"]  # in the figure's frame
    color: str  # CSS
    meta: Any = None  # what the page's script knows of it
    # Of a surface: the rows of three points each, which are its corners then.
    faces: Int[np.ndarray, "F 3"] | None = None


class Panel(NamedTuple):
    """One of the 3-D views side by side."""

    title: str
    clouds: Sequence[Cloud]


def subsample(points: np.ndarray, max_points: int) -> np.ndarray:
    """At most so many of the points, drawn evenly; the same ones every time."""
    if len(points) <= max_points:
        return points
    chosen = np.random.default_rng(0).choice(len(points), max_points, replace=False)
    return points[np.sort(chosen)]


def clouds_figure(
    panels: Sequence[Panel],
    toward_viewer: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    bounds: Float[np.ndarray, "2 3"] | None = None,
) -> go.Figure:
    """Panels side by side on one scale, seen from one direction, `toward_viewer` with
    `up`. The axes are the points' own, less what their titles say where the origin is
    far away. They span `bounds`, a lower and an upper corner, or all points."""
    titles = [panel.title for panel in panels]
    specs = [[{"type": "scene"}] * len(titles)]
    figure = _side_by_side(titles, 0.01, specs=specs)
    clouds = [(column, c) for column, p in enumerate(panels, 1) for c in p.clouds]
    if bounds is None:
        everything = np.concatenate([cloud.points for _, cloud in clouds])
        bounds = np.stack([everything.min(axis=0), everything.max(axis=0)])
    shift, extent = axis_shift(bounds), float(np.ptp(bounds, axis=0).max())
    listed = set()
    for column, cloud in clouds:
        trace = _trace(cloud, shift, extent, cloud.name not in listed)
        figure.add_trace(trace, 1, column).data[-1].meta = cloud.meta
        listed.add(cloud.name)
    box = axis_box(bounds - shift, shift)
    camera = framing(box, toward_viewer, up, PAGE_ASPECT / len(titles))
    figure.update_scenes(box, dragmode="orbit", camera=camera)
    legend = {"orientation": "h", "itemsizing": "constant"}
    below = {"x": 0.5, "xanchor": "center", "y": 0, "yanchor": "top"}
    figure = _styled(figure, height=520)
    return figure.update_layout(legend={**legend, **below}, margin={"t": 64})


def by_error(
    sigma: Float[np.ndarray, " M"] | None,
    which: Bool[np.ndarray, " M"],
    count: int = MAX_SHOWN_POINTS,
) -> dict[str, Any]:
    """The colour "error" of the points of one cloud, as the page's script takes it.
    Numbers where they were added, thinned to `count` as the cloud is; grey where they
    were measured, for whom the expected errors are 0; nothing without these."""
    if sigma is None:
        return {}
    shown = subsample(sigma[which], count)
    if not shown.any():
        return {"error": SUPPORT_COLOR}
    return {"error": [float(f"{value:.3g}") for value in shown]}


def added(completed: Any) -> tuple[str, str]:
    """What was added to an object is called, and its colour: a known model's surface,
    or what the network predicted."""
    if completed.label.max() == KNOWN:
        return "known", KNOWN_COLOR
    return "completed", COMPLETED_COLOR


def of_object(
    completed: Any, count: int = MAX_SHOWN_POINTS, prefix: str = "", **about: Any
) -> list[Cloud]:
    """What was measured of an object, at most `count` points, what was added to it, and
    the mesh of the model that it is, unless that is so fine that its points must do.
    `about` goes to the page's script, and in it the `color` of each way to colour."""
    name, color = added(completed)
    colors, clouds = about.pop("color", {}), []
    for cloud, which, own in (
        ("observed", completed.observed, OBSERVED_COLOR),
        (name, ~completed.observed, color),
    ):
        by = {"": own, **colors, **by_error(completed.sigma, which, count)}
        points = subsample(completed.points[which], count)
        meta = {"cloud": cloud, **about, "color": by}
        clouds.append(Cloud(prefix + cloud, points, own, meta))
    found = completed.known
    if found is None or found.model is None or len(found.model.faces) > MAX_FACES:
        return clouds
    rotation, shift = found.match.pose[:3, :3], found.match.pose[:3, 3]
    corners = found.model.vertices @ rotation.T + shift
    meta = {"cloud": name, **about, "color": dict.fromkeys(["", *colors], color)}
    return [*clouds, Cloud("known", corners, KNOWN_COLOR, meta, found.model.faces)]


def tell_errors(figure: go.Figure, sigma: Float[np.ndarray, " M"] | None) -> list[str]:
    """Gives the figure the colours of errors, for traces whose markers have numbers for
    colours, with a bar that is not shown yet; the names of the ways to colour that are
    added by that, one or none."""
    if sigma is None or not sigma.any():
        return []
    most = float(np.quantile(sigma[sigma > 0], ERRORS_SHOWN))
    title = "expected error<br>(input units)"
    bar = {"title": {"text": title}, "thickness": 14, "len": 0.7}
    bar |= {"x": 1.0, "xanchor": "right"}
    scale = {"colorscale": "Viridis", "cmin": 0.0, "cmax": most, "showscale": False}
    figure.update_layout(coloraxis={**scale, "colorbar": bar})
    return ["error"]


def depth_figure(
    titles: tuple[str, str],
    depths: Sequence[Float[np.ndarray, "H W"]],
    masks: Sequence[Bool[np.ndarray, "H W"]],
) -> go.Figure:
    """Depth maps before and after on one colour scale; grey where there is no point."""
    figure = _side_by_side(titles, 0.06)
    for column, (depth, mask) in enumerate(zip(depths, masks, strict=True), start=1):
        shown = np.where(mask, depth, np.nan).astype(np.float32)
        hover = "u %{x}, v %{y}<br>depth %{z:.4g}<extra></extra>"
        trace = go.Heatmap(z=shown, coloraxis="coloraxis", hovertemplate=hover)
        figure.add_trace(trace, 1, column)
        axis = "x" if column == 1 else f"x{column}"
        height, width = depth.shape
        figure.update_xaxes(range=[-0.5, width - 0.5], col=column)
        figure.update_yaxes(range=[height - 0.5, -0.5], scaleanchor=axis, col=column)
    frame: dict[str, Any] = {"constrain": "domain", "mirror": True, "linecolor": _LINE}
    frame |= dict.fromkeys(("showgrid", "zeroline", "showticklabels"), False)
    figure.update_xaxes(**frame, ticks="")
    figure.update_yaxes(**frame, ticks="")
    bar = {"title": {"text": "depth<br>(input units)"}, "thickness": 16}
    scale = {"colorscale": "Viridis", "reversescale": True, "colorbar": bar}
    figure = _styled(figure, height=430)
    return figure.update_layout(plot_bgcolor=_NO_DEPTH, coloraxis=scale)


def losses_figure(losses: Mapping[str, Sequence[float]]) -> go.Figure:
    """Each loss by adaptation step, on a scale of its own; the titles are the keys."""
    figure = _side_by_side(list(losses), 0.28 / max(len(losses), 2))
    for column, values in enumerate(losses.values(), start=1):
        trace = go.Scatter(
            x=list(range(len(values))),
            y=list(values),
            mode="lines+markers",
            line={"color": OBSERVED_COLOR, "width": 2},
            marker={"size": 7},
            hovertemplate="step %{x}: %{y:.5g}<extra></extra>",
        )
        figure.add_trace(trace, 1, column)
    figure.update_xaxes(title_text="step", dtick=1, gridcolor=_GRID, zeroline=False)
    figure.update_yaxes(gridcolor=_GRID, zeroline=False, nticks=5, exponentformat="e")
    return _styled(figure, height=260).update_layout(
        showlegend=False, plot_bgcolor="white", margin={"b": 48, "l": 56}
    )


def axis_shift(bounds: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "3"]:
    """What is taken off each axis: round numbers near the middle of a box that is so
    far away that float32, in which browsers draw, would show steps."""
    lower, upper = bounds.astype(np.float64)
    extent = (upper - lower).max() or 1.0
    middle = (lower + upper) / 2
    unit = 10.0 ** np.ceil(np.log10(extent))
    far = np.abs(middle) > 1000 * extent
    return np.where(far, np.round(middle / unit) * unit, 0.0)


def marker_size(points: Float[np.ndarray, "N 3"], extent: float) -> float:
    """The diameter in pixels that makes a surface of the points, not a blot. `extent`
    is the longest side of the box that is shown."""
    least, most = MARKER_SIZES
    if len(points) < 2 or not extent > 0:
        return most
    asked = subsample(points, 500)
    spacing = np.median(KDTree(points).query(asked, k=2)[0][:, 1])
    return float(np.clip(0.8 * SHOWN_PIXELS * spacing / extent, least, most))


def axis_box(
    bounds: Float[np.ndarray, "2 3"], shift: Float[np.ndarray, "3"]
) -> dict[str, Any]:
    """Axes around the bounds with a margin, and one scale for all three. `shift` was
    taken off the bounds already; titles say it."""
    lower, upper = bounds
    extent = (upper - lower).max() or 1.0
    sides = np.maximum(1.06 * (upper - lower), 0.15 * extent)
    center = (lower + upper) / 2
    box: dict[str, Any] = {}
    for name, middle, side, less in zip("xyz", center, sides, shift, strict=True):
        title: dict[str, Any] = {"text": name}
        if less:
            title = {"text": f"{name} - {less:,.10g}", "font": {"size": 10}}
        reach = [float(middle - side / 2), float(middle + side / 2)]
        box[f"{name}axis"] = {"range": reach, "title": title, **_AXIS}
    ratio = _vector(1.6 * sides / np.linalg.norm(sides))
    return {**box, "aspectmode": "manual", "aspectratio": ratio}


def framing(
    box: Mapping[str, Any],
    toward_viewer: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    aspect: float = PAGE_ASPECT,
) -> dict[str, Any]:
    """Plotly's camera that has an `axis_box` and its labels fill a view. `aspect` is
    the view's width to its height."""
    sides = np.array([box["aspectratio"][name] for name in "xyz"])
    right = np.cross(up, toward_viewer)
    right = right / (np.linalg.norm(right) or 1.0)
    corners = sides * np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    across = 1.35 * np.abs(corners @ right) / aspect
    upwards = 1.25 * np.abs(corners @ np.cross(toward_viewer, right))
    # Plotly's angle of view is 45 degrees from top to bottom.
    needed = np.maximum(across, upwards) / np.tan(np.pi / 8)
    far = (needed + corners @ toward_viewer).max()
    # What is near looks larger, and from above it is at the bottom.
    center = -0.08 * up
    eye = _vector(far * toward_viewer + center)
    return {"eye": eye, "center": _vector(center), "up": _vector(up)}


def _trace(
    cloud: Cloud, shift: np.ndarray, extent: float, in_legend: bool
) -> go.Scatter3d | go.Mesh3d:
    count = MAX_SHOWN_POINTS if cloud.faces is None else len(cloud.points)
    points = (subsample(cloud.points, count) - shift).astype(np.float32)
    places = dict(zip("xyz", points.T, strict=True))
    if cloud.faces is not None:
        faces = dict(zip("ijk", cloud.faces.astype(np.int32).T, strict=True))
        look = {"color": cloud.color, "opacity": 0.3, "hoverinfo": "skip"}
        return go.Mesh3d(**places, **faces, **look, name=cloud.name)
    return go.Scatter3d(
        **places,
        mode="markers",
        name=cloud.name,
        legendgroup=cloud.name,
        showlegend=in_legend,
        marker={"size": marker_size(points, extent), "color": cloud.color},
        hovertemplate="x %{x:.4g}<br>y %{y:.4g}<br>z %{z:.4g}",
    )


def _side_by_side(titles: Sequence[str], gap: float, **more: Any) -> go.Figure:
    about = {"subplot_titles": list(titles), "horizontal_spacing": gap, **more}
    return make_subplots(rows=1, cols=len(titles), **about)


def _vector(direction: np.ndarray) -> dict[str, float]:
    return {name: float(v) for name, v in zip("xyz", direction, strict=True)}


def _styled(figure: go.Figure, height: int) -> go.Figure:
    figure.update_annotations(font={**_FONT, "size": 14}, yanchor="bottom")
    return figure.update_layout(
        template="none",
        font=_FONT,
        height=height,
        margin={"l": 8, "r": 8, "t": 40, "b": 8},
        paper_bgcolor="white",
    )
