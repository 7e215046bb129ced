"""What result.json says of a completion."""

import importlib.metadata
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax import io
from prism_jax.evaluation import metrics, scoring
from prism_jax.geometry.workspace import Workspace
from prism_jax.losses.weighting import BRANCHES


def summarize(result: Any, scan: io.Scan, source: str, **asked: Any) -> dict[str, Any]:
    """The content of result.json except times and scores. Lengths are in its `unit`.
    `result` is a `CompletedScan` of `scan`, which was read from `source`; the others
    are what the user asked for, with the `bounds` of the workspace."""
    bounds = asked.pop("bounds")
    own = _of_object(result)
    own["workspace"]["bounds"] = bounds
    about = _about(scan, source)
    about["input"]["points_left_out"] = result.left_out
    return {**about, **asked, **own, "ground_truth": None, "scores": None}


def summarize_scene(
    scene: Any, scan: io.Scan, source: str, **asked: Any
) -> dict[str, Any]:
    """The same of a `prism_jax.completion.assembly.CompletedScene`: each object's part
    of it is an entry of ``objects``, in the order of their numbers."""
    bounds = asked.pop("bounds")
    measured = scene.object[scene.observed]
    counts = {
        "partial": len(measured),
        "completed": len(scene.points),
        "support": int((measured == -1).sum()),
        "left_over": int((measured == -2).sum()),
    }
    planes = [
        {"normal": np.asarray(plane.normal), "offset": float(plane.offset)}
        for plane in scene.planes
    ]
    return {
        **_about(scan, source),
        **asked,
        "up": np.asarray(scene.up),
        "up_source": scene.up_source,
        "bounds": bounds,
        "points": counts,
        "planes": planes,
        "objects": [_of_object(one) for one in scene.objects],
    }


def _about(scan: io.Scan, source: str) -> dict[str, Any]:
    """What a result says of the software and its input."""
    return {
        "prism_jax": software(),
        "unit": scan.unit,
        "input": {
            "file": source,
            "fields": list(scan.fields),
            "points_read": len(scan.points) + scan.num_outside + scan.num_not_finite,
            "points_not_finite": scan.num_not_finite,
            "points_outside": scan.num_outside,
        },
    }


def _of_object(result: Any) -> dict[str, Any]:
    """What it says of one completed object."""
    verdict = result.verdict
    return {
        **({} if result.known is None else {"known": result.known.told()}),
        "verdict": None if verdict is None else verdict._asdict(),
        "sigma": _of_added(result),
        "accepted": bool(result.accepted),
        "points": {name: len(cloud) for name, cloud in clouds(result).items()},
        "left_away": dict(result.left_away),
        "capped": bool(result.capped),
        "workspace": {
            "center": np.asarray(result.workspace.center),
            "half_extent": float(result.workspace.half_extent),
        },
        "camera": io.camera_to_dict(result.camera),
        "sensor": result.sensor,
        "losses": dict(result.losses),
        "loss_weights": dict(zip(BRANCHES, result.weights, strict=True)),
    }


def _of_added(result: Any) -> dict[str, float] | None:
    """What the sigmas of the added points are like; None if there is no such point, or
    weights that cannot tell."""
    if result.sigma is None or result.observed.all():
        return None
    sigma = result.sigma[~result.observed]
    least, median, most = np.quantile(sigma, [0.05, 0.5, 0.95])
    return {"mean": sigma.mean(), "median": median, "q05": least, "q95": most}


def clouds(result: Any) -> dict[str, Float[np.ndarray, "_ 3"]]:
    """The three clouds of a result by name, in the user's frame and units: `partial`,
    the measured points; `network`, all that the network predicts; `completed`, the
    measured points and then those that are added to them."""
    return {
        "partial": result.points[result.observed],
        "network": result.prediction,
        "completed": result.points,
    }


def score(result: Any, ground_truth: Float[np.ndarray, "G 3"]) -> dict[str, Any]:
    """The metrics of all `clouds` against the truth, without the EMD, as in
    `prism_jax.evaluation`. No cloud is thinned: that would change how much measured and
    predicted points weigh against each other."""
    unit = Workspace.from_points(np.asarray(ground_truth, np.float64), margin=1.0)

    def in_unit(cloud: np.ndarray) -> np.ndarray:
        return np.asarray(unit.to_unit(cloud.astype(np.float64)))

    given = {name: in_unit(cloud) for name, cloud in clouds(result).items()}
    scores = scoring.score(given, given["partial"], in_unit(ground_truth))
    return {
        "unit": metrics.UNIT,
        "unit_length": float(unit.half_extent),
        "f_score_threshold": metrics.F_SCORE_THRESHOLD,
        "clouds": {name: found.named() for name, found in scores.items()},
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


def software() -> str | None:
    """The installed version of prism_jax; None where it is not installed."""
    try:
        return importlib.metadata.version("prism_jax")
    except importlib.metadata.PackageNotFoundError:
        return None
