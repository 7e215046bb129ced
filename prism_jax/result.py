"""What result.json says of a completion."""

import importlib.metadata
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax import io, metrics
from prism_jax.adaptation.config import BRANCHES
from prism_jax.figures import subsample

MAX_SCORED_POINTS = 50_000
"""Larger clouds are thinned, evenly and always alike, before they are scored."""

F_SCORE_THRESHOLD = 0.01
"""One hundredth of the workspace's half extent."""


def summarize(
    result: Any,
    scan: io.Scan,
    source: str,
    *,
    weights: str,
    adapt: bool,
    up: str,
    bounds: str | None,
) -> dict[str, Any]:
    """The content of result.json but for times and scores. Lengths in input units.

    ``result`` is a `prism_jax.completion.CompletedScan` of ``scan``, which was read
    from ``source``; the others are what the user asked for.
    """
    observed = int(np.sum(result.observed))
    return {
        "prism_jax": _version(),
        "input": {
            "file": source,
            "points_read": len(scan.points) + scan.num_outside + scan.num_not_finite,
            "points_not_finite": scan.num_not_finite,
            "points_outside": scan.num_outside,
        },
        "ground_truth": None,
        "weights": weights,
        "adapt": adapt,
        "accepted": bool(result.accepted),
        "points": {
            "observed": observed,
            "completed": len(result.points) - observed,
            "network_output": len(result.prediction),
        },
        "workspace": {
            "center": np.asarray(result.workspace.center),
            "half_extent": float(result.workspace.half_extent),
            "bounds": bounds,
        },
        "camera": io.camera_to_dict(result.camera),
        "up": up,
        "sensor": result.sensor,
        "losses": dict(result.losses),
        "loss_weights": dict(zip(BRANCHES, result.weights, strict=True)),
        "metrics": None,
    }


def score(result: Any, ground_truth: Float[np.ndarray, "G 3"]) -> dict[str, Any]:
    """The partial, the network's output and what the user gets, against the truth.

    All in workspace units, the half extent being 1: multiply CD-L1 and Hausdorff by
    it for lengths in input units. Conventions: `prism_jax.metrics`.
    """
    center = np.asarray(result.workspace.center, dtype=np.float64)
    half_extent = float(result.workspace.half_extent)

    def unit(points: np.ndarray) -> np.ndarray:
        thinned = subsample(np.asarray(points, dtype=np.float64), MAX_SCORED_POINTS)
        return (thinned - center) / half_extent

    target = unit(ground_truth)
    clouds = {
        "partial": result.points[result.observed],
        "network_output": result.prediction,
        "completed": result.points,
    }
    return {
        "units": "1 is half the side of the workspace",
        "f_score_threshold": F_SCORE_THRESHOLD,
        "max_points": MAX_SCORED_POINTS,
        **{name: _scores(unit(points), target) for name, points in clouds.items()},
    }


def plain(value: Any) -> Any:
    """The value as strict JSON has it: arrays as lists, what is not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _scores(prediction: np.ndarray, target: np.ndarray) -> dict[str, float]:
    return {
        "cd_l1": metrics.cd_l1(prediction, target),
        "cd_l2": metrics.cd_l2(prediction, target),
        "f_score": metrics.f_score(prediction, target, F_SCORE_THRESHOLD),
        "hausdorff": metrics.hausdorff(prediction, target),
    }


def _version() -> str | None:
    try:
        return importlib.metadata.version("prism_jax")
    except importlib.metadata.PackageNotFoundError:
        return None
