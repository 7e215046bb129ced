"""Scores of anything that completes clouds, on any data set."""

from prism_jax.evaluation.comparison import Row, comparison
from prism_jax.evaluation.paired import paired_difference
from prism_jax.evaluation.protocol import NORMALISATIONS, Protocol
from prism_jax.evaluation.published import (
    PUBLISHED,
    published_columns,
    published_options,
)
from prism_jax.evaluation.run import (
    CompleteFn,
    Predictions,
    evaluate,
    network_completer,
    prism_completer,
)
from prism_jax.evaluation.tables import (
    agreement_markdown,
    comparison_markdown,
    markdown,
    published_markdown,
)

__all__ = [
    "NORMALISATIONS",
    "PUBLISHED",
    "CompleteFn",
    "Predictions",
    "Protocol",
    "Row",
    "agreement_markdown",
    "comparison",
    "comparison_markdown",
    "evaluate",
    "markdown",
    "network_completer",
    "paired_difference",
    "prism_completer",
    "published_columns",
    "published_markdown",
    "published_options",
]
