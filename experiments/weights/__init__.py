"""Weights to compare with: those of ablations, of the control, and of baselines.

The weights that people use ship with the package; `prism_jax.completion.weights` knows
them.
"""

import pathlib

from prism_jax.completion.weights import SUFFIX


def located(name_or_path: str) -> str:
    """The file of weights that lie here, by their name; anything else as it is."""
    path = pathlib.Path(__file__).parent / f"{name_or_path}{SUFFIX}"
    return str(path) if path.is_file() else name_or_path
