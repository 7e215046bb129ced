"""The page that all reports share, and figures in it."""

from typing import Any

import jinja2
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from prism_jax.assets import asset
from prism_jax.reporting.confidence import TRUST_COLORS
from prism_jax.reporting.details import number

_BUTTONS = [["orbitRotation", "pan3d", "resetCameraDefault3d", "toImage"]]


def render(template: str = "page.html", **content: Any) -> str:
    """The page as HTML with its styles and scripts inlined, about 5 MB and the clouds.
    ``content`` is what the template, a file of `assets/report`, names."""
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        loader=jinja2.FileSystemLoader(asset("report")),
    )
    environment.filters["number"] = number
    page = environment.get_template(template)
    return page.render(plotly=get_plotlyjs(), trust_colors=TRUST_COLORS, **content)


def clouds_html(figure: go.Figure) -> str:
    """Clouds that fill the box that the page gives them."""
    layout: Any = figure.layout
    figure.update_layout(
        height=None,
        showlegend=False,
        modebar={"orientation": "v"},  # Beside the titles, not over them.
        margin={"t": 26 if layout.annotations else 0, "b": 0},
    )
    return _html(figure, "clouds", modeBarButtons=_BUTTONS)


def chart_html(figure: go.Figure, name: str) -> str:
    """A figure of a fixed height that is only looked at."""
    return _html(figure, name, displayModeBar=False)


def _html(figure: go.Figure, name: str, **config: Any) -> str:
    return figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=name,
        default_height="100%",
        config={"displaylogo": False, "responsive": True, **config},
    )
