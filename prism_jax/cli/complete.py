"""prism-complete: completes partial scans and writes clouds and reports.

    prism-complete --input=scan.ply --output_dir=out
    prism-complete scan.ply others/ --output_dir=out

Without a scan it completes a bundled sample. If the input cannot be used, it exits with
status 2 and one line on stderr. If only some of several inputs cannot be used, the
others are completed and the status is 1.
"""

import contextlib
import functools
import json
import pathlib
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from absl import flags

from prism_jax import io
from prism_jax.assets import asset
from prism_jax.cli.index import index_page
from prism_jax.cli.launch import SomeFailed, launch
from prism_jax.preprocessing.upright import parse_up
from prism_jax.reporting import render_report, render_scene_report
from prism_jax.reporting.confidence import verdict_of_scene
from prism_jax.reporting.summary import plain, score, summarize, summarize_scene

FLAGS = flags.FLAGS
NAME = "prism-complete"
LIST = "list"

_SETTINGS = (
    "ground_truth",
    "camera",
    "workspace",
    "max_points",
    "up",
    "objects",
    "weights",
    "adapt",
    "density",
    "background",
    "output_dir",
)
"""The flags that are arguments of `complete_file`."""

_SCANS = (".ply", ".pcd", ".npy", ".npz", ".xyz", ".txt", ".csv", ".png")
"""What is taken from a folder."""

PATIENCE = 2.0  # seconds after which a step says what it is doing


def define_flags() -> None:
    """The flags; what they are called and what they default to is `complete_file`'s."""
    flags.DEFINE_string(
        "input",
        None,
        "Partial scan: .ply .pcd .npy .npz .xyz .txt .csv, or a 16-bit depth .png. "
        "Default: a bundled sample.",
    )
    flags.DEFINE_string("ground_truth", None, "Complete cloud to score against.")
    flags.DEFINE_string(
        "camera",
        None,
        "Camera JSON. Default for a depth image: the .json of the same name. Default "
        "for a cloud: a camera at the origin that looks at the points; if the origin "
        "is too far away, among the points, or on their far side, the position is "
        "estimated from the points.",
    )
    flags.DEFINE_string(
        "workspace",
        None,
        "Box x0,y0,z0,x1,y1,z1 in input units that the scan and the ground truth are "
        "cropped to. Points outside it still show which space is free. Added points "
        "may lie outside the box, but inside the completed cube: its side is 1.4 times "
        "the longest side of the cropped points.",
    )
    flags.DEFINE_integer(
        "max_points",
        io.MAX_POINTS,
        "Files with more points or pixels are rejected before they are read.",
        lower_bound=1,
    )
    flags.DEFINE_string(
        "up",
        None,
        "Up direction in the input frame: x, y, z, -x, -y, -z, three numbers x,y,z, "
        "or auto: the normal of the support plane, else the up direction of the "
        "camera, else z. Default: -y for a depth image in its camera's own axes; z "
        "for a cloud, and if the camera is rotated by 10 degrees or more (--camera).",
    )
    flags.DEFINE_enum(
        "objects",
        "auto",
        ["auto", "one"],
        "auto: remove support planes and complete each object separately. "
        "one: treat all points as one object.",
    )
    flags.DEFINE_string(
        "weights",
        "small",
        f"Name of released weights, or a weights file; {LIST} prints the names.",
    )
    flags.DEFINE_bool("card", False, "Print the model card of --weights and exit.")
    flags.DEFINE_bool(
        "adapt",
        False,
        "Adapt the network to the scan first, as in the paper. Slower, with no "
        "reliable benefit.",
    )
    flags.DEFINE_float(
        "density",
        1.0,
        "Density of added points relative to measured ones, where the network "
        "predicts a surface; 0 keeps the predicted points as they are.",
        lower_bound=0.0,
    )
    flags.DEFINE_enum(
        "background",
        "unknown",
        ["unknown", "empty"],
        "empty: the sensor saw nothing else nearby, so no points are added there.",
    )
    flags.DEFINE_string("output_dir", "prism_output", "Output folder.")


def main(inputs: Sequence[str] = ()) -> None:
    """Does what the flags ask for, with scans and folders of scans beside --input."""
    if FLAGS.weights == LIST:
        print(weights_that_ship())
        return
    if FLAGS.card:
        # It imports data sets and scores, which a completion does not wait for.
        from prism_jax.reporting.model_card import model_card

        print(model_card(FLAGS.weights), end="")
        return
    settings = {name: getattr(FLAGS, name) for name in _SETTINGS}
    if inputs:
        complete_files([*([FLAGS.input] if FLAGS.input else []), *inputs], **settings)
    else:
        summary = complete_file(FLAGS.input, **settings)
        print(outcome(summary, FLAGS.output_dir))


def complete_file(
    input: str | None = None,
    *,
    ground_truth: str | None = None,
    camera: str | None = None,
    workspace: str | None = None,
    max_points: int = io.MAX_POINTS,
    up: str | None = None,
    objects: str = "auto",
    weights: str = "small",
    adapt: bool = False,
    density: float = 1.0,
    background: str = "unknown",
    output_dir: str = "prism_output",
) -> dict[str, Any]:
    """Completes one scan and writes completed.ply, report.html and result.json.

    The arguments are the flags of the command. A scan that `objects` "auto" takes apart
    is completed object by object; one with a ground truth never is. Returns the content
    of result.json, which is written last. Everything the user can put right raises an
    InputError, and all that can be known to be wrong does so before the weights are
    loaded. What takes over two seconds says so on stderr.
    """
    seconds: dict[str, float] = {}
    bounds = None if workspace is None else io.parse_bounds(workspace)
    direction = None if up is None else parse_up(up)
    source = str(asset("sample.ply")) if input is None else input
    truth = None
    with timed(f"reading {source}", "read", seconds):
        scan = io.read_scan(source, camera, bounds, max_points)
        if ground_truth is not None:
            truth = io.read_points(ground_truth, max_points)
            truth = io.crop(truth, bounds, ground_truth)
            if not np.ptp(truth, axis=0).any():
                fault = "all points coincide"
                raise io.InputError(ground_truth, fault, "give the complete cloud")
    folder = io.make_output_dir(output_dir)
    with timed(f"loading the weights {weights}", "load", seconds):
        completer = load_completer(weights)
    if direction is None:
        direction = "-y" if scan.in_camera_frame else "z"
    scene, taken_apart = None, False
    if objects == "auto" and truth is None:
        with timed("looking for objects", "split", seconds):
            scene = completer.split_scene(scan.points, scan.camera, direction)
            taken_apart = bool(scene.planes) or len(scene.num_points) > 1
    count = f"{len(scan.points):,} points (the first run on a machine also compiles)"
    doing = "adapting to and completing" if adapt else "completing"
    asked: dict[str, Any] = {"adapt": adapt, "up": direction, "density": density}
    asked["background"] = background
    given = scan.points, scan.camera
    with timed(f"{doing} {count}", "complete", seconds):
        if taken_apart:
            result = completer.complete_scene(
                *given, scene=scene, around=scan.around, **asked
            )
        else:
            result = completer.complete(*given, around=scan.around, **asked)
    about = {"weights": weights, "bounds": workspace, **asked}
    if not taken_apart and up == "auto":
        about["up"] = result.workspace.up
    if taken_apart:
        return _write_scene(folder, result, scan, source, about, seconds)
    if result.sensor == "unknown":
        say(
            "the origin cannot be the sensor position: it is too far away, among the "
            "points, or on their far side; the position was estimated from the points; "
            "set it with --camera"
        )
    if result.left_out:
        count = f"{result.left_out:,} of {len(scan.points):,} points"
        say(f"{count} are far from all others and were removed")
    warn_of_low_trust("this completion", result.verdict)
    doubted = result.verdict is not None and result.verdict.trust != "high"
    if doubted and background == "unknown" and scan.around is None:
        say(
            "the surroundings are unknown; if the sensor saw nothing else and the scan "
            "is not a crop, --background=empty reduces outliers"
        )
    seconds.update(result.seconds)
    summary = summarize(result, scan, source, **about)
    if truth is not None:
        with timed("scoring against the ground truth", "score", seconds):
            summary["scores"] = score(result, truth)
        summary["ground_truth"] = {"file": ground_truth, "points": len(truth)}
    summary["seconds"] = seconds
    with timed(f"writing to {folder}", "write", seconds):
        report = render_report(result, plain(summary), truth)
        cloud = io.ply_bytes(result.points, ~result.observed, sigma=result.sigma)
        _write(folder, cloud, report, plain(summary))
    return plain(summary)


def complete_files(
    inputs: Sequence[str], *, output_dir: str, **settings: Any
) -> dict[str, dict[str, Any]]:
    """Completes several scans, each into a folder of its own, with an index page.

    ``inputs`` are files and folders of them, ``settings`` the arguments of
    `complete_file` for all. The network is compiled once. Returns the results by the
    folders' names. What cannot be used is told at the end, when everything else is
    done: SomeFailed is raised then, or an InputError if nothing could be used.
    """
    if settings.get("ground_truth") is not None:
        fault = "cannot be used with several scans"
        raise io.InputError("--ground_truth", fault, "score the scans one by one")
    jobs = _jobs(inputs)
    folder = io.make_output_dir(output_dir)
    done: dict[str, dict[str, Any]] = {}
    faults: list[io.InputError] = []
    for number, (name, path) in enumerate(jobs.items(), 1):
        say(f"{number} of {len(jobs)}: {path}")
        try:
            own = str(folder / name)
            done[name] = complete_file(str(path), output_dir=own, **settings)
        except io.InputError as error:
            faults.append(error)
    failed = [str(error) for error in faults]
    page = index_page(done, failed)
    io.write_together({folder / "index.html": page.encode(errors="backslashreplace")})
    print(f"written     {output_dir}: index.html and {len(done)} folders")
    if faults and not done:
        raise faults[0]
    if faults:
        raise SomeFailed(failed)
    return done


def _jobs(inputs: Sequence[str]) -> dict[str, pathlib.Path]:
    """The files that the inputs name, by the folder that each is written to."""
    paths: list[pathlib.Path] = []
    for given in map(pathlib.Path, inputs):
        if given.is_dir():
            inside = sorted(p for p in given.iterdir() if p.suffix.lower() in _SCANS)
            if not inside:
                remedy = f"supported suffixes: {' '.join(_SCANS)}"
                raise io.InputError(given, "no scans in this folder", remedy)
            paths += inside
        else:
            paths.append(given)
    jobs: dict[str, pathlib.Path] = {}
    for path in paths:
        name, again = path.stem, 1
        while name in jobs:
            again += 1
            name = f"{path.stem}-{again}"
        jobs[name] = path
    return jobs


@functools.cache
def load_completer(weights: str) -> Any:
    """The completer, imported this late so that bad input is refused in a moment.

    The same one for the same weights, so that several scans compile once.
    """
    from prism_jax.completion.completer import Completer

    return Completer.from_pretrained(weights, io.default_cache_dir() / "traced")


def weights_that_ship() -> str:
    """A table of them, and how to read more."""
    from prism_jax.completion.weights import available_weights
    from prism_jax.reporting.model_card import weights_table

    return (
        f"{weights_table(available_weights())}\n\n"
        "CD-L2 x1e4, in half the longest side of the true shape; lower is better. "
        f"{NAME} --weights=NAME --card prints data, licences and all scores."
    )


def outcome(summary: dict[str, Any], output_dir: str) -> str:
    """What was done, in a few lines."""
    written = f"written     {output_dir}: completed.ply, result.json, report.html"
    partial, completed = (summary["points"][k] for k in ("partial", "completed"))
    counts = f"points      {partial:,} observed, {completed - partial:,} added"
    if "objects" in summary:
        support, rest = (summary["points"][k] for k in ("support", "left_over"))
        objects = (
            f"objects     {len(summary['objects'])}; {support:,} points on removed "
            f"planes, {rest:,} in no object"
        )
        trust = f"confidence  {verdict_of_scene(summary['objects'])['text']}"
        return f"{trust}\n{objects}\n{counts}\n{written}"
    trust = "confidence  unknown: these weights have no calibration"
    if summary["verdict"] is not None:
        verdict = summary["verdict"]
        error = f"{verdict['expected_error']:.3g}"
        trust = (
            f"confidence  {verdict['trust']}: expected error {error}, in input units"
        )
    adapted = "off"
    if summary["adapt"] and len(summary["losses"]["objective"]) == 1:
        adapted = "none, these weights use no adaptation steps"
    elif summary["adapt"]:
        adapted = "accepted" if summary["accepted"] else "rejected, not used"
    return f"{trust}\n{counts}\nadaptation  {adapted}\n{written}"


@contextlib.contextmanager
def timed(
    text: str, name: str, seconds: dict[str, float], command: str = NAME
) -> Iterator[None]:
    """Puts the time it took into `seconds`; says on stderr what takes long."""
    start = time.perf_counter()
    timer = threading.Timer(PATIENCE, lambda: say(f"{text} ...", command))
    timer.daemon = True
    timer.start()
    try:
        yield
        seconds[name] = time.perf_counter() - start
        if seconds[name] > PATIENCE:
            say(f"... done in {seconds[name]:.1f} s", command)
    finally:
        timer.cancel()


def warn_of_low_trust(what: str, verdict: Any) -> None:
    """Says why a completion may be wrong, and what to do."""
    if verdict is not None and verdict.trust == "low":
        why = "; ".join(verdict.reasons) or "the combined evidence"
        say(f"low confidence in {what}: {why}")


def say(text: str, command: str = NAME) -> None:
    """One line to the user, on stderr."""
    print(f"{command}: {text}", file=sys.stderr, flush=True)


def _write_scene(
    folder: pathlib.Path,
    result: Any,
    scan: io.Scan,
    source: str,
    about: Mapping[str, Any],
    seconds: dict[str, float],
) -> dict[str, Any]:
    """Writes a scene's files and returns the content of result.json."""
    for number, one in enumerate(result.objects):
        warn_of_low_trust(f"object {number}", one.verdict)
    summary = {**summarize_scene(result, scan, source, **about), "seconds": seconds}
    with timed(f"writing to {folder}", "write", seconds):
        report = render_scene_report(result, plain(summary))
        about_points = ~result.observed, result.object, result.sigma
        cloud = io.ply_bytes(result.points, *about_points)
        _write(folder, cloud, report, plain(summary))
    return plain(summary)


def _write(
    folder: pathlib.Path, cloud: bytes, report: str, summary: Mapping[str, Any]
) -> None:
    text = json.dumps(summary, indent=2, allow_nan=False)
    contents = {
        "completed.ply": cloud,
        # A file's name may hold bytes that are no UTF-8.
        "report.html": report.encode(errors="backslashreplace"),
        "result.json": (text + "\n").encode(),
    }
    io.write_together({folder / name: data for name, data in contents.items()})


def run() -> None:
    """The entry point of `prism-complete`."""
    define_flags()
    launch(NAME, main, takes_words=True)


if __name__ == "__main__":
    run()
