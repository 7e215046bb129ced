"""The main job: files in, a completed cloud, its figures and a report out."""

import contextlib
import dataclasses
import importlib.metadata
import importlib.resources
import json
import math
import pathlib
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax import io, metrics
from prism_jax.adaptation.config import BRANCHES
from prism_jax.figures import subsample
from prism_jax.report import render_report

PATIENCE = 2.0
"""Seconds after which a stage says what it is doing."""

MAX_SCORED_POINTS = 50_000
"""Larger clouds are thinned, evenly and always alike, before they are scored."""

F_SCORE_THRESHOLD = 0.01
"""One hundredth of the workspace's half extent."""


@dataclasses.dataclass(frozen=True)
class CompletionJob:
    """What to complete; the fields are the flags of `experiments.complete`."""

    input: str | None = None
    ground_truth: str | None = None
    camera: str | None = None
    workspace: str | None = None
    up: str | None = None
    weights: str = "small"
    adapt: bool = True
    output_dir: str = "prism_output"


def run_job(job: CompletionJob) -> dict[str, Any]:
    """Complete one scan and write completed.ply, report.html and result.json.

    Returns the content of result.json, which is written last. Everything the user can
    put right raises an InputError, and all that can be known to be wrong does so
    before the weights are loaded. What takes over two seconds is told on stderr.
    """
    seconds: dict[str, float] = {}
    bounds = io.parse_bounds(job.workspace) if job.workspace is not None else None
    source = job.input if job.input is not None else str(asset("sample.ply"))
    with stage(f"reading {source}", "read", seconds):
        scan = io.read_scan(source, job.camera, bounds)
        ground_truth = _read_ground_truth(job, bounds)
    output_dir = io.make_output_dir(job.output_dir)
    with stage(f"loading the weights {job.weights}", "load", seconds):
        completer = load_completer(job.weights)
    with stage(_announcement(job, len(scan.points)), "complete", seconds):
        result = completer.complete(
            scan.points,
            camera=scan.camera,
            adapt=job.adapt,
            up=axis_up(job, scan),
        )
    if result.sensor == "unknown":
        say(
            "the origin is too far away to be the sensor's place, or among the points; "
            "it is taken to be obliquely above; give it with --camera"
        )
    seconds.update(result.seconds)
    summary = summarize(job, source, scan, result)
    if ground_truth is not None:
        with stage("scoring against the ground truth", "score", seconds):
            summary["metrics"] = scores(result, ground_truth)
        file = str(job.ground_truth)
        summary["ground_truth"] = {"file": file, "points": len(ground_truth)}
    summary["seconds"] = seconds
    with stage(f"writing to {output_dir}", "write", seconds):
        _write(output_dir, result, plain(summary), ground_truth)
    return plain(summary)


def axis_up(job: CompletionJob, scan: io.Scan) -> str:
    """The axis that points upwards: as asked; -y in a camera's own axes; else z."""
    return job.up or ("-y" if scan.in_camera_frame else "z")


def summarize(
    job: CompletionJob, source: str, scan: io.Scan, result: Any
) -> dict[str, Any]:
    """The content of result.json but for times and scores. Lengths in input units."""
    observed = int(np.sum(result.observed))
    workspace = {
        "center": np.asarray(result.workspace.center),
        "half_extent": float(result.workspace.half_extent),
        "bounds": job.workspace,
    }
    return {
        "prism_jax": _version(),
        "input": {
            "file": source,
            "points_read": len(scan.points) + scan.num_outside + scan.num_not_finite,
            "points_not_finite": scan.num_not_finite,
            "points_outside": scan.num_outside,
        },
        "ground_truth": None,
        "weights": job.weights,
        "adapt": job.adapt,
        "accepted": bool(result.accepted),
        "points": {
            "observed": observed,
            "completed": len(result.points) - observed,
            "network_output": len(result.prediction),
        },
        "workspace": workspace,
        "camera": io.camera_to_dict(result.camera),
        "up": axis_up(job, scan),
        "sensor": result.sensor,
        "losses": dict(result.losses),
        "loss_weights": dict(zip(BRANCHES, result.weights, strict=True)),
        "metrics": None,
    }


def scores(result: Any, ground_truth: Float[np.ndarray, "G 3"]) -> dict[str, Any]:
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
        **{name: _score(unit(points), target) for name, points in clouds.items()},
    }


def asset(name: str) -> pathlib.Path:
    """A file that is installed with the package."""
    return pathlib.Path(str(importlib.resources.files("prism_jax") / "assets" / name))


def load_completer(weights: str) -> Any:
    """The completer, imported this late so that bad input is refused in a moment."""
    from prism_jax.completion import Completer

    return Completer.from_pretrained(weights, io.default_cache_dir() / "traced")


@contextlib.contextmanager
def stage(text: str, name: str, seconds: dict[str, float]) -> Iterator[None]:
    """Time a stage into `seconds`, and say on stderr what it is if it takes long."""
    start = time.perf_counter()
    timer = threading.Timer(PATIENCE, lambda: say(f"{text} ..."))
    timer.daemon = True
    timer.start()
    try:
        yield
        seconds[name] = time.perf_counter() - start
        if seconds[name] > PATIENCE:
            say(f"... done in {seconds[name]:.1f} s")
    finally:
        timer.cancel()


def say(text: str) -> None:
    """One line to the user, on stderr."""
    print(f"prism-complete: {text}", file=sys.stderr, flush=True)


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


def _read_ground_truth(
    job: CompletionJob, bounds: io.Bounds | None
) -> np.ndarray | None:
    if job.ground_truth is None:
        return None
    return io.crop(io.read_points(job.ground_truth), bounds, job.ground_truth)


def _announcement(job: CompletionJob, num_points: int) -> str:
    how = "adapting to and completing" if job.adapt else "completing"
    return f"{how} {num_points:,} points (the first run on a machine also compiles)"


def _score(prediction: np.ndarray, target: np.ndarray) -> dict[str, float]:
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


def _write(
    output_dir: pathlib.Path,
    result: Any,
    summary: Mapping[str, Any],
    ground_truth: np.ndarray | None,
) -> None:
    text = json.dumps(summary, indent=2, allow_nan=False)
    report = render_report(result, summary, ground_truth)
    contents = {
        "completed.ply": io.ply_bytes(result.points, ~result.observed),
        # A file's name may hold bytes that are no UTF-8.
        "report.html": report.encode(errors="backslashreplace"),
        "result.json": (text + "\n").encode(),
    }
    io.write_together({output_dir / name: data for name, data in contents.items()})
