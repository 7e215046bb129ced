"""Scores of anything that completes clouds, on any data set."""

from prism_jax.evaluation.frames import NORMALISATIONS, Protocol
from prism_jax.evaluation.published import (
    PUBLISHED,
    published_columns,
    published_options,
)
from prism_jax.evaluation.run import CompleteFn, evaluate, prism_completer
from prism_jax.evaluation.summary import paired_difference
from prism_jax.evaluation.tables import markdown, published_markdown

__all__ = [
    "NORMALISATIONS",
    "PUBLISHED",
    "CompleteFn",
    "Protocol",
    "evaluate",
    "markdown",
    "paired_difference",
    "prism_completer",
    "published_columns",
    "published_markdown",
    "published_options",
]
