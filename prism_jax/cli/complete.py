"""prism-complete: completes partial scans and writes clouds and reports.

    prism-complete [SCAN or FOLDER ...] [flags]
    prism-complete --input=scan.ply --output_dir=out
    prism-complete scan.ply others/ --output_dir=out

Without a scan it completes a bundled sample. If the input cannot be used, or nothing
of it is completed, it exits with status 2 and one line on stderr. If that is so of some
of several inputs, the others are completed and the status is 1.
"""

import functools
import inspect
import json
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from absl import flags

from prism_jax import io
from prism_jax.assets import asset
from prism_jax.cli import shared_flags
from prism_jax.cli.launch import launch, load_completer, load_library, say, timed
from prism_jax.completion.filtering import MAX_DENSE
from prism_jax.io.atomic import check_targets, claim
from prism_jax.io.clouds import READERS, rounding
from prism_jax.io.scan import parse_numbers, standing_at
from prism_jax.preprocessing.segmentation.background import sees_scene
from prism_jax.preprocessing.segmentation.support import tilt_of
from prism_jax.preprocessing.upright import AUTO, parse_up
from prism_jax.reporting import render_report, render_scene_report
from prism_jax.reporting.confidence import trust_of_all
from prism_jax.reporting.page import render
from prism_jax.reporting.summary import plain, score, summarize, summarize_scene
from prism_jax.uncertainty.confidence import CLOSED, SCENE

FLAGS = flags.FLAGS
NAME = "prism-complete"
LIST = "list"  # in place of a name of weights
FEW = 50  # scans, for which a quick compilation saves more time than it costs

_SCANS = (*READERS, ".png")  # what is taken from a folder
TILTED = 10.0  # in degrees: a floor or table that leans more contradicts --up
BARE = 0.01  # a plane with fewer points beside it is a floor or a wall
_FILES = "completed.ply", "report.html", "result.json"

_timed = functools.partial(timed, NAME)
_say = functools.partial(say, NAME)


def define_flags() -> None:
    """The flags; what they are called and what they default to is `complete_file`'s."""
    shared_flags.define_strings(
        input=f"Partial scan: {' '.join(READERS)}, or a 16-bit depth .png. Default: a "
        "bundled sample.",
        ground_truth="Complete cloud to score against.",
        camera="Camera as JSON, or YAML of ROS or OpenCV. Default for a depth image: "
        "the .json of the same name. Default for a cloud: a camera at the origin that "
        "looks at the points; if the origin is too far away, among the points, or on "
        "their far side, the position is estimated from the points.",
        eye="Sensor position of a cloud, x,y,z, if it is not --camera's. Default: a "
        "PCD's VIEWPOINT, unless that is the origin.",
        workspace="Box x0,y0,z0,x1,y1,z1 in input units that the scan and the ground "
        "truth are cropped to. Points outside it still show which space is free. "
        "Added points may lie outside the box, but inside the completed cube: its "
        "side is 1.4 times the longest side of the cropped points.",
    )
    shared_flags.define_max_points(io.MAX_POINTS)
    shared_flags.define_completion_flags(density=1.0)
    flags.DEFINE_enum(
        "objects",
        "auto",
        ["auto", "one"],
        "auto: remove support planes and complete each object separately. "
        "one: treat all points as one object.",
    )
    flags.DEFINE_bool("card", False, "Print the model card of --weights and exit.")
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
    if len(inputs) == 1 and not FLAGS.input and not pathlib.Path(inputs[0]).is_dir():
        FLAGS.input, inputs = inputs[0], ()
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
    eye: str | None = None,
    workspace: str | None = None,
    max_points: int = io.MAX_POINTS,
    up: str | None = None,
    objects: str = "auto",
    weights: str = "small",
    adapt: bool = False,
    density: float = 1.0,
    background: str = "unknown",
    known: str | None = None,
    known_unit: str | None = None,
    output_dir: str = "prism_output",
    quick: bool = True,
) -> dict[str, Any]:
    """Completes one scan and writes completed.ply, report.html and result.json.

    The arguments are the flags of the command, and ``quick``, which is `Completer`'s.
    Returns the content of result.json, which is written last. Everything the user can
    put right raises an InputError, and all that can be known to be wrong does so before
    the weights are loaded.
    """
    seconds: dict[str, float] = {}
    direction = None if up is None else parse_up(up)
    source = str(asset("sample.ply")) if input is None else input
    # Read the scan and, to score against, the truth.
    with _timed(f"reading {source}", "read", seconds):
        scan, truth = _read(source, camera, workspace, max_points, ground_truth)
    view = _view(scan, eye, source)
    if rounded := rounding(scan.points):
        _say(rounded)
    folder = claim(output_dir)
    check_targets(folder / name for name in _FILES)
    library = None
    if known is not None or known_unit is not None:
        with _timed(f"preparing the models of {known}", "models", seconds):
            library = load_library(known, known_unit)
    with _timed(f"loading the weights {weights}", "load", seconds):
        completer = load_completer(weights, quick).knowing(library)
    # Take it apart into objects, unless it is one.
    if direction is None:
        direction = "-y" if scan.in_camera_frame else "z"
    scene = None
    if objects == "auto" and truth is None:
        with _timed("looking for objects", "split", seconds):
            scene = completer.split_scene(scan.points, view, direction)
        scene, direction = _taken_apart(scene, direction, up, scan, view, source)
    # Complete each of them, or all of it.
    asked: dict[str, Any] = {"adapt": adapt, "up": direction, "density": density}
    asked["background"] = background
    count = f"{len(scan.points):,} points (the first run on a machine also compiles)"
    doing = "adapting to and completing" if adapt else "completing"
    given = {"camera": view, "around": scan.around, **asked}
    with _timed(f"{doing} {count}", "complete", seconds):
        if scene is None:
            result = completer.complete(scan.points, **given)
        else:
            result = completer.complete_scene(scan.points, scene=scene, **given)
    about = {"weights": weights, "bounds": workspace, **asked}
    if scene is None:
        seconds.update(result.seconds)
        about["up"] = result.workspace.up if up == AUTO else direction
        summary = summarize(result, scan, source, **about)
        _warn(result, scan, objects, background)
    else:
        summary = summarize_scene(result, scan, source, **about)
        for number, one in enumerate(result.objects):
            _warn_of_low_trust(f"object {number}", one)
    if library is not None:
        _tell_of_known([result] if scene is None else result.objects)
    if result.observed.all():
        closed = scene is None and result.verdict and CLOSED in result.verdict.reasons
        _say(CLOSED if closed else "nothing was added: what is predicted is measured")
    if truth is not None:
        with _timed("scoring against the ground truth", "score", seconds):
            summary["scores"] = score(result, truth)
        summary["ground_truth"] = {"file": ground_truth, "points": len(truth)}
    summary["seconds"] = seconds
    # Write the cloud, the report and its numbers.
    with _timed(f"writing to {folder}", "write", seconds):
        contents = _contents(result, plain(summary), scan, truth)
        places = (folder / name for name in _FILES)
        io.write_together(dict(zip(places, contents, strict=True)))
    return plain(summary)


_SETTINGS = tuple(inspect.signature(complete_file).parameters)[1:-1]


def _read(
    source: str,
    camera: str | None,
    workspace: str | None,
    max_points: int,
    ground_truth: str | None,
) -> tuple[io.Scan, np.ndarray | None]:
    """The scan, and the truth if there is one, both within the workspace."""
    bounds = None if workspace is None else io.parse_bounds(workspace)
    if pathlib.Path(source).is_dir():
        remedy = "to complete all scans in it, give it without --input"
        raise io.InputError(source, "a folder, not a scan", remedy)
    scan = io.read_scan(source, camera, bounds, max_points, _say)
    if ground_truth is None:
        return scan, None
    truth = io.read_points(ground_truth, max_points)
    truth = io.parted(truth, bounds, ground_truth)[0]
    if not np.ptp(truth, axis=0).any():
        fault = "all points coincide"
        raise io.InputError(ground_truth, fault, "give the complete cloud")
    return scan, truth


def _taken_apart(
    scene: Any, direction: Any, up: str | None, scan: io.Scan, view: Any, source: str
) -> tuple[Any, Any]:
    """The scene if each of its objects is to be completed by itself, else None; and up,
    which may be found in it. InputError about a scene without an object."""
    tilt = tilt_of(scene.planes, direction)
    if tilt > TILTED:
        fault = f"the largest plane is tilted by {tilt:.0f} degrees"
        _say(f"{fault} against --up={up or direction}; try --up=auto")
    if scene.planes and not scene.num_points:
        _check_not_empty(scene, scan, view, source)
        _say("nearly all points are on planes: completed as one object")
    elif scene.planes or len(scene.num_points) > 1:
        if not scene.planes:
            parts = f"{len(scene.num_points)} parts lie apart and are completed as"
            _say(f"{parts} objects; --objects=one takes them for one")
        return scene, direction
    is_auto = isinstance(direction, str) and direction == AUTO
    return None, scene.up.vector if is_auto else direction


def _contents(
    result: Any, told: dict[str, Any], scan: io.Scan, truth: np.ndarray | None
) -> tuple[bytes, ...]:
    """What each of `_FILES` holds."""
    if "objects" in told:
        report, numbers = render_scene_report(result, told), result.object
        fields = scan.fields
    else:
        report, numbers = render_report(result, told, truth), None
        fields = {name: held[result.inside] for name, held in scan.fields.items()}
    cloud = result.points, result.label, numbers, result.sigma, fields
    return (
        io.ply_bytes(*cloud),
        # A file's name may hold bytes that are no UTF-8.
        report.encode(errors="backslashreplace"),
        f"{json.dumps(told, indent=2, allow_nan=False)}\n".encode(),
    )


def _tell_of_known(objects: Sequence[Any]) -> None:
    """Says which objects are models, and why others are not the nearest one."""
    for number, found in enumerate(one.known for one in objects):
        if found.model is not None:
            told = " or ".join([found.model.name, *found.equal])
        else:
            name, why = next(iter(found.refused.items()))
            told = f"none of the models, nearest {name}: {why}"
        _say(f"object {number} is {told}")
    if all(one.known.model is None and one.sensor != "given" for one in objects):
        _say("set --eye or --camera if the sensor did not stand at 0,0,0")


def _check_not_empty(scene: Any, scan: io.Scan, view: Any, source: str) -> None:
    """InputError if a scan without objects is not of one object with flat faces either:
    a bare floor or wall, or an empty room."""
    eye = None if view is None else np.asarray(view.position)
    bare = len(scene.planes) == 1 and scene.num_left_over < BARE * len(scan.points)
    if bare or sees_scene(scan.points, eye):
        fault = f"no object: {scene.num_support:,} points are on planes, "
        fault += f"{scene.num_left_over:,} are outliers or too small"
        remedy = "crop it to the object (--workspace), or set --objects=one"
        raise io.InputError(source, fault, remedy)


def _view(scan: io.Scan, eye: str | None, source: str) -> Any:
    """The camera of a scan, or one that stands where the flag or the file says."""
    if eye is not None and source.lower().endswith(".png"):
        raise io.InputError("--eye", "not supported for depth images", "omit it")
    place = scan.eye
    if eye is not None:
        place = parse_numbers("--eye", eye, 3, "give x,y,z")
    elif place is not None:
        _say(f"the sensor is at {','.join(f'{v:g}' for v in place)}, the VIEWPOINT")
    return scan.camera if place is None else standing_at(place)


def _warn(result: Any, scan: io.Scan, objects: str, background: str) -> None:
    """Says what may be wrong with one completed object, and what to do."""
    if result.verdict and SCENE in result.verdict.reasons:
        _warn_of_low_trust("this completion", result)
        if objects == "one":
            _say("--objects=auto may take it apart into objects")
        return
    if result.sensor == "unknown":
        _say(
            "the sensor hardly stood at the origin, so its position was estimated from "
            "the points; set it with --eye"
        )
    if result.left_out:
        count = f"{result.left_out:,} of {len(scan.points):,} points"
        _say(f"{count} are far from all others and were removed")
    _warn_of_low_trust("this completion", result)
    doubted = result.verdict is not None and result.verdict.trust != "high"
    if doubted and background == "unknown" and scan.around is None:
        _say(
            "the surroundings are unknown; if the sensor saw nothing else and the scan "
            "is not a crop, --background=empty reduces outliers"
        )


def _warn_of_low_trust(what: str, completed: Any) -> None:
    """Says why a completion is doubted, or less dense than was asked for."""
    if completed.capped:
        _say(f"{what}: limited to {MAX_DENSE:,} added points; --density asks for more")
    verdict = completed.verdict
    if verdict is not None and verdict.trust == "low":
        why = "; ".join(verdict.reasons) or "the combined evidence"
        _say(f"low confidence in {what}: {why}")


def complete_files(inputs: Sequence[str], *, output_dir: str, **settings: Any) -> None:
    """Completes several scans, files and folders of them, each into a folder of its
    own, with an index page. What cannot be used is told when everything else is done,
    and the status is 1 then; InputError if nothing could be used."""
    if settings.get("ground_truth") is not None:
        fault = "cannot be used with several scans"
        raise io.InputError("--ground_truth", fault, "score the scans one by one")
    jobs = _jobs(inputs)
    folder = claim(output_dir)
    check_targets([folder / "index.html"])
    done: dict[str, dict[str, Any]] = {}
    faults: list[io.InputError] = []
    for number, (name, path) in enumerate(jobs.items(), 1):
        _say(f"{number} of {len(jobs)}: {path}")
        try:
            own = {"output_dir": str(folder / name), "quick": len(jobs) <= FEW}
            done[name] = complete_file(str(path), **own, **settings)
        except io.InputError as error:
            faults.append(error)
    failed = [str(error) for error in faults]
    if faults and not done:
        raise faults[0]
    rows = [(name, result, trust_of_all(result)) for name, result in done.items()]
    page = render("index.html", rows=rows, failed=failed)
    io.write_together({folder / "index.html": page.encode(errors="backslashreplace")})
    folders = f"{len(done)} folder{'s' if len(done) != 1 else ''}"
    print(f"written     {output_dir}: index.html and {folders}")
    if faults:
        _say(f"\n{NAME}: ".join(failed))
        sys.exit(1)


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
        name, again = _folder_name(path), 1
        while name.casefold() in ("index.html", *map(str.casefold, jobs)):
            again += 1
            name = f"{_folder_name(path)}-{again}"
        jobs[name] = path
    return jobs


def _folder_name(path: pathlib.Path) -> str:
    """The stem, without what is hidden, separates, or cannot be shown."""
    plain = (c if c.isprintable() and c not in "/\\:" else "_" for c in path.stem)
    return "".join(plain).strip(". ") or "scan"


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
    trust = "unknown: these weights have no calibration"
    if "objects" in summary:
        support, rest = (summary["points"][k] for k in ("support", "left_over"))
        objects = (
            f"objects     {len(summary['objects'])}; {support:,} points on removed "
            f"planes, {rest:,} in no object"
        )
        if {one["verdict"] is None for one in summary["objects"]} != {True}:
            trust = trust_of_all(summary)
        return f"confidence  {trust}\n{objects}\n{counts}\n{written}"
    verdict = summary["verdict"]
    if verdict is not None:
        error = f"expected error {verdict['expected_error']:.3g}"
        error += " m" if summary["unit"] == "m" else f", in {summary['unit']}"
        trust = f"{verdict['trust']}: {error}"
    adapted = "off"
    if summary["adapt"] and not summary["losses"]:
        adapted = "none, these weights use no adaptation steps"
    elif summary["adapt"]:
        adapted = "accepted" if summary["accepted"] else "rejected, not used"
    return f"confidence  {trust}\n{counts}\nadaptation  {adapted}\n{written}"


def run() -> None:
    """The entry point of `prism-complete`."""
    define_flags()
    launch(NAME, main, takes_words=True)


if __name__ == "__main__":
    run()
