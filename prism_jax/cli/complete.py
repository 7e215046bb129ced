"""prism-complete: a partial scan in; the completed cloud, its figures and a report out.

    prism-complete --input=scan.ply --output_dir=out

Without --input it completes a sample that ships with the package. If the input cannot
be used, it ends with status 2 and one line on stderr.
"""

import contextlib
import json
import pathlib
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from absl import flags

from prism_jax import io
from prism_jax.assets import asset
from prism_jax.cli.launch import launch
from prism_jax.report import render_report
from prism_jax.result import plain, score, summarize

FLAGS = flags.FLAGS
NAME = "prism-complete"
LIST = "list"

PATIENCE = 2.0
"""Seconds after which a step says what it is doing."""


def define_flags() -> None:
    """The flags; what they are called and what they default to is `complete_file`'s."""
    flags.DEFINE_string(
        "input",
        None,
        "Partial scan: .ply .pcd .npy .npz .xyz .txt .csv, or a 16-bit depth .png. "
        "A bundled sample if not given.",
    )
    flags.DEFINE_string("ground_truth", None, "Complete cloud to score against.")
    flags.DEFINE_string(
        "camera",
        None,
        "JSON of the camera that saw the scan. For a depth image: the .json of the "
        "same name if not given. For a cloud: one at the origin looking at it, or "
        "obliquely above if the origin is far away, as a map's is, or among the "
        "points.",
    )
    flags.DEFINE_string(
        "workspace",
        None,
        "Box to crop the scan to, x0,y0,z0,x1,y1,z1 in the units of the input, and "
        "the ground truth alike. What is added may reach beyond it, within the "
        "cube that is completed: its side is 1.4 times the points' longest.",
    )
    flags.DEFINE_integer(
        "max_points",
        io.MAX_POINTS,
        "A file of more points or pixels is refused before it is read.",
        lower_bound=1,
    )
    flags.DEFINE_enum(
        "up",
        None,
        ["x", "y", "z", "-x", "-y", "-z"],
        "Axis of the input that points upwards. If not given, -y for a depth "
        "image in its camera's own axes, and z for one whose camera is turned by "
        "10 degrees or more (--camera) and for a cloud.",
    )
    flags.DEFINE_string(
        "weights",
        "small",
        f"Name of released weights, or a file of them; {LIST} prints what ships.",
    )
    flags.DEFINE_bool("adapt", True, "Adapt the network to the scan first.")
    flags.DEFINE_float(
        "density",
        1.0,
        "Added points are so many times as dense as the measured ones, where the "
        "network's output is a surface; 0 leaves them as predicted.",
        lower_bound=0.0,
    )
    flags.DEFINE_string("output_dir", "prism_output", "Where the results are written.")


def main() -> None:
    """Does what the flags ask for."""
    if FLAGS.weights == LIST:
        print(weight_cards())
        return
    summary = complete_file(
        input=FLAGS.input,
        ground_truth=FLAGS.ground_truth,
        camera=FLAGS.camera,
        workspace=FLAGS.workspace,
        max_points=FLAGS.max_points,
        up=FLAGS.up,
        weights=FLAGS.weights,
        adapt=FLAGS.adapt,
        density=FLAGS.density,
        output_dir=FLAGS.output_dir,
    )
    print(outcome(summary, FLAGS.output_dir))


def complete_file(
    *,
    input: str | None = None,
    ground_truth: str | None = None,
    camera: str | None = None,
    workspace: str | None = None,
    max_points: int = io.MAX_POINTS,
    up: str | None = None,
    weights: str = "small",
    adapt: bool = True,
    density: float = 1.0,
    output_dir: str = "prism_output",
) -> dict[str, Any]:
    """Completes one scan and writes completed.ply, report.html and result.json.

    The arguments are the flags of the command. Returns the content of result.json,
    which is written last. Everything the user can put right raises an InputError, and
    all that can be known to be wrong does so before the weights are loaded. What takes
    over two seconds says so on stderr.
    """
    seconds: dict[str, float] = {}
    bounds = None if workspace is None else io.parse_bounds(workspace)
    source = str(asset("sample.ply")) if input is None else input
    truth = None
    with timed(f"reading {source}", "read", seconds):
        scan = io.read_scan(source, camera, bounds, max_points)
        if ground_truth is not None:
            truth = io.read_points(ground_truth, max_points)
            truth = io.crop(truth, bounds, ground_truth)
            if not np.ptp(truth, axis=0).any():
                fault = "has all its points in one place"
                raise io.InputError(ground_truth, fault, "give a whole cloud")
    folder = io.make_output_dir(output_dir)
    with timed(f"loading the weights {weights}", "load", seconds):
        completer = load_completer(weights)
    up = up or ("-y" if scan.in_camera_frame else "z")
    count = f"{len(scan.points):,} points (the first run on a machine also compiles)"
    doing = "adapting to and completing" if adapt else "completing"
    with timed(f"{doing} {count}", "complete", seconds):
        asked = {"adapt": adapt, "up": up, "density": density}
        result = completer.complete(scan.points, camera=scan.camera, **asked)
    if result.sensor == "unknown":
        say(
            "the origin is too far away to be the sensor's place, or among the points; "
            "it is taken to be obliquely above; give it with --camera"
        )
    if result.left_out:
        count = f"{result.left_out:,} of {len(scan.points):,} points"
        say(f"{count} lie far from all others and were left out")
    seconds.update(result.seconds)
    summary = summarize(
        result, scan, source, weights=weights, bounds=workspace, **asked
    )
    if truth is not None:
        with timed("scoring against the ground truth", "score", seconds):
            summary["scores"] = score(result, truth)
        summary["ground_truth"] = {"file": ground_truth, "points": len(truth)}
    summary["seconds"] = seconds
    with timed(f"writing to {folder}", "write", seconds):
        _write(folder, result, plain(summary), truth)
    return plain(summary)


def load_completer(weights: str) -> Any:
    """The completer, imported this late so that bad input is refused in a moment."""
    from prism_jax.completion import Completer

    return Completer.from_pretrained(weights, io.default_cache_dir() / "traced")


def weight_cards() -> str:
    """A card of each of the weights that ship."""
    # This imports data sets and scores, which a completion does not wait for.
    from prism_jax.model_card import model_card
    from prism_jax.weights import available_weights

    return "\n".join(model_card(name) for name in available_weights())


def outcome(summary: dict[str, Any], output_dir: str) -> str:
    """What was done, in three lines."""
    partial, completed = (summary["points"][k] for k in ("partial", "completed"))
    adapted = "not asked for"
    if summary["adapt"] and len(summary["losses"]["objective"]) == 1:
        adapted = "none, these weights take no step"
    elif summary["adapt"]:
        adapted = "accepted" if summary["accepted"] else "not accepted, left out"
    return (
        f"points      {partial:,} observed, {completed - partial:,} added\n"
        f"adaptation  {adapted}\n"
        f"written     {output_dir}: completed.ply, result.json, report.html"
    )


@contextlib.contextmanager
def timed(text: str, name: str, seconds: dict[str, float]) -> Iterator[None]:
    """Puts the time it took into `seconds`; says on stderr what takes long."""
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
    print(f"{NAME}: {text}", file=sys.stderr, flush=True)


def _write(
    folder: pathlib.Path,
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
    io.write_together({folder / name: data for name, data in contents.items()})


def run() -> None:
    """The entry point of `prism-complete`."""
    define_flags()
    launch(NAME, main, stray="input")


if __name__ == "__main__":
    run()
