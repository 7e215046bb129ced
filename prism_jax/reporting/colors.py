"""The ways in which a report colours clouds, beside what they are."""

from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Bool, Float

from prism_jax.reporting.figures import (
    MAX_SHOWN_POINTS,
    SUPPORT_COLOR,
    color_by,
    subsample,
)

BULK = 0.95
"""The share of the added points with errors that colours tell apart; the rest have the
colour of the largest."""


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


def tell_errors(figure: go.Figure, sigma: Float[np.ndarray, " M"] | None) -> list[str]:
    """Gives the figure the colours of errors; the names of the ways to colour that are
    added by that, one or none."""
    if sigma is None or not sigma.any():
        return []
    most = float(np.quantile(sigma[sigma > 0], BULK))
    color_by(figure, "expected error<br>(input units)", most)
    return ["error"]
