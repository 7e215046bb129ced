"""What turning, tilting, thinning, noise and cropping do to completions.

    python -m experiments.robustness --weights=small --output=FILE.json

Every view of a validation split is shifted (`experiments.shifts`) and completed as a
user's scan is, by `Completer`. Each shift is written as soon as it is done. Those that
the file has of the same weights and views, and that --shift does not ask for, stay.
"""

import concurrent.futures
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from absl import flags
from jaxtyping import Float
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.scoring import write_result
from experiments.settings import changed
from experiments.shifts import SHIFTS, View, validation_views
from experiments.weights import located
from prism_jax import io, metrics
from prism_jax.cli.launch import launch
from prism_jax.completed import CompletedScan
from prism_jax.completion import Completer
from prism_jax.data.datasets import digest_of, validation_split
from prism_jax.evaluation.tables import short
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import Background
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import choose
from prism_jax.observation.support import find_up
from prism_jax.observation.upright import upright
from prism_jax.training.run import commit
from prism_jax.weights import sha256

FLAGS = flags.FLAGS

COLUMNS = {
    "CD-L2 x1e4": ("cd_l2", np.mean, 1e4),
    "median": ("cd_l2", np.median, 1e4),
    "prediction to truth x1e4": ("prediction_to_truth", np.mean, 1e4),
    "truth to prediction x1e4": ("truth_to_prediction", np.mean, 1e4),
    "CD-L1 x1e3": ("cd_l1", np.mean, 1e3),
}


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "A name, or a file.")
    flags.DEFINE_enum("dataset", "shapes", ("shapes", "roboarm"), "Whose validation.")
    flags.DEFINE_multi_string("scan", [], "Real scans instead, with --ground_truth.")
    flags.DEFINE_string("ground_truth", None, "The true shape of those scans.")
    flags.DEFINE_string("up", "z", "Axis of the real scans that points upwards.")
    flags.DEFINE_integer("limit", None, "So many views, evenly spaced.", lower_bound=1)
    flags.DEFINE_multi_string("shift", list(SHIFTS), "Which ones.")
    flags.DEFINE_bool("adapt", False, "Adapt to each view.")
    flags.DEFINE_enum(
        "background", "unknown", ["unknown", "empty"], "What is said of it."
    )
    flags.DEFINE_multi_string(
        "set", [], "Changes to the weights' settings, as model.heading=given."
    )
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Shifts, completes, scores, writes and prints the table."""
    prepare_output(FLAGS.output, ".json")
    for name in FLAGS.shift:
        choose("shift", name, SHIFTS)
    completer = Completer.from_pretrained(located(FLAGS.weights))
    completer.config = changed(completer.config, FLAGS.set)
    views, about = _views()
    about |= {
        "weights": FLAGS.weights,
        "variables_sha256": sha256(completer.variables),
        "adapt": FLAGS.adapt,
        "set": " ".join(FLAGS.set) or None,
        "background": FLAGS.background if FLAGS.background != "unknown" else None,
    }
    rows, made_at = _rows_before(about), commit()
    result = {**about, "shifts": rows}
    # While one view is completed, those before are scored.
    with (
        tqdm(total=len(FLAGS.shift) * len(views), mininterval=2.0) as bar,
        concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool,
    ):
        for name in FLAGS.shift:
            scores = []
            for number, view in enumerate(views):
                shifted = SHIFTS[name](view, np.random.default_rng(number))
                done = completed(completer, shifted, FLAGS.adapt, FLAGS.background)
                scores.append(pool.submit(score, shifted, done.points))
                bar.update()
            row = _summary([waiting.result() for waiting in scores])
            rows[name] = {"views": len(views), "commit": made_at, **row}
            result["shifts"] = {name: rows[name] for name in SHIFTS if name in rows}
            write_result(result)
    print(robustness_markdown(result))


def _rows_before(about: Mapping[str, Any]) -> dict[str, Any]:
    """What --output has of these weights and views."""
    path = pathlib.Path(FLAGS.output or "")
    if not path.is_file():
        return {}
    before = json.loads(path.read_text())
    same = all(before.get(name) == value for name, value in about.items())
    return before["shifts"] if same else {}


def score(view: View, points: Float[np.ndarray, "N 3"]) -> dict[str, dict[str, float]]:
    """The scores of the partial and of what a user gets, by cloud and metric."""
    unit = 0.5 * view.size
    clouds = {"partial": view.partial, "completed": points}
    return {
        name: metrics.score(cloud / unit, view.complete / unit).named()
        for name, cloud in clouds.items()
    }


def completed(
    completer: Completer, view: View, adapt: bool, background: Background = "unknown"
) -> CompletedScan:
    """As a user's scan is. A view with a table, with the way up that the table says."""
    camera, up = None, "z"
    if view.eye is not None:
        camera = Camera.look_at(view.eye, view.partial.mean(axis=0))
    if view.table is not None:
        up = find_up(np.concatenate([view.partial, view.table]), view.eye).vector
    return completer.complete(
        view.partial, camera, adapt=adapt, up=up, background=background
    )


def robustness_markdown(result: Mapping[str, Any]) -> str:
    """A row for each shift."""
    commits = {row["commit"] or "unknown": None for row in result["shifts"].values()}
    changes = f", {result['set']}" if result.get("set") else ""
    if result.get("background"):
        changes += f", background {result['background']}"
    lines = [
        f"`{result['weights']}`{changes}, commit {', '.join(map(short, commits))}, "
        f"views of {result['data']}. Unit of length: {metrics.UNIT}.\n",
        f"| shift | views | the partial's CD-L2 x1e4 | {' | '.join(COLUMNS)} |",
        f"| --- | --- | --- |{' --- |' * len(COLUMNS)}",
    ]
    for name, row in result["shifts"].items():
        cells = [f"{row['completed'][column]:.4g}" for column in COLUMNS]
        partial = f"{row['partial']['CD-L2 x1e4']:.4g}"
        lines.append(f"| {name} | {row['views']} | {partial} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _views() -> tuple[list[View], dict[str, Any]]:
    """The views that are shifted, and what the result says of them."""
    if FLAGS.scan:
        if FLAGS.ground_truth is None:
            fault = "is missing, and --scan has nothing to be compared with"
            raise io.InputError("--ground_truth", fault, "give the true shape")
        turn = Workspace(np.zeros(3), np.ones(()), upright(FLAGS.up))
        truth = io.read_points(FLAGS.ground_truth).astype(np.float64)
        truth = np.asarray(turn.to_unit(truth))
        names = [pathlib.Path(path).stem for path in FLAGS.scan]
        scans = [io.read_scan(path).points.astype(np.float64) for path in FLAGS.scan]
        size = float(np.ptp(truth, axis=0).max())
        clouds = [np.asarray(turn.to_unit(scan)) for scan in scans]
        views = [View(cloud, truth, None, size) for cloud in clouds]
        return views, {"data": ", ".join(names)}
    split = validation_split(FLAGS.dataset)
    views = validation_views(FLAGS.dataset, FLAGS.limit)
    digest = digest_of(FLAGS.dataset, split)
    return views, {"data": f"{FLAGS.dataset}, {split}", "digest": digest}


def _summary(scores: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    return {
        cloud: {
            title: factor * float(mean([row[cloud][metric] for row in scores]))
            for title, (metric, mean, factor) in COLUMNS.items()
        }
        for cloud in ("partial", "completed")
    }


def run() -> None:
    """The entry point."""
    define_flags()
    launch("robustness", main)


if __name__ == "__main__":
    run()
