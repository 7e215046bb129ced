"""What result.json says of a completion."""

import importlib.metadata
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax import io, metrics
from prism_jax.geometry.workspace import Workspace
from prism_jax.losses.weighting import BRANCHES


def summarize(
    result: Any,
    scan: io.Scan,
    source: str,
    *,
    weights: str,
    adapt: bool,
    up: str,
    density: float,
    bounds: str | None,
) -> dict[str, Any]:
    """The content of result.json except times and scores. Lengths in input units.

    ``result`` is a `prism_jax.completion.CompletedScan` of ``scan``, which was read
    from ``source``; the others are what the user asked for.
    """
    return {
        "prism_jax": _version(),
        "input": {
            "file": source,
            "points_read": len(scan.points) + scan.num_outside + scan.num_not_finite,
            "points_not_finite": scan.num_not_finite,
            "points_outside": scan.num_outside,
            "points_left_out": result.left_out,
        },
        "ground_truth": None,
        "weights": weights,
        "adapt": adapt,
        "accepted": bool(result.accepted),
        "points": {name: len(cloud) for name, cloud in clouds(result).items()},
        "left_away": dict(result.left_away),
        "density": density,
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
        "scores": None,
    }


def clouds(result: Any) -> dict[str, Float[np.ndarray, "_ 3"]]:
    """The three clouds of a result by name, in the user's frame and units.

    ``partial`` holds the measured points in the workspace, ``network`` the network's
    own output, ``completed`` the measured points and, where nothing was measured,
    predicted ones.
    """
    return {
        "partial": result.points[result.observed],
        "network": result.prediction,
        "completed": result.points,
    }


def score(result: Any, ground_truth: Float[np.ndarray, "G 3"]) -> dict[str, Any]:
    """The metrics of all `clouds` against the truth, without the EMD.

    Functions and unit are those of `prism_jax.evaluation`. No cloud is thinned: that
    would change how much measured and predicted points weigh against each other.
    """
    truth = np.asarray(ground_truth, np.float64)
    unit = Workspace.from_points(truth, margin=1.0)

    def scored(cloud: np.ndarray) -> dict[str, float]:
        points = np.asarray(unit.to_unit(cloud.astype(np.float64)))
        return metrics.score(points, target).named()

    target = np.asarray(unit.to_unit(truth))
    return {
        "unit": metrics.UNIT,
        "unit_length": float(unit.half_extent),
        "f_score_threshold": metrics.F_SCORE_THRESHOLD,
        "clouds": {name: scored(cloud) for name, cloud in clouds(result).items()},
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


def _version() -> str | None:
    try:
        return importlib.metadata.version("prism_jax")
    except importlib.metadata.PackageNotFoundError:
        return None
