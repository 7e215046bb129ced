"""prism-envelope: what of a workspace is taken, what may be, and what is free.

    prism-envelope calibrate RECORDINGS --output=cal.json
    prism-envelope SCAN --calibration=cal.json --alpha=0.1 --output_dir=out

Not safety-rated; no claim to any standard; people are never predicted. If the input or
the calibration cannot be used, it ends with status 2 and one line on stderr.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from absl import flags

from prism_jax import io
from prism_jax.cli.complete import load_completer, say, timed
from prism_jax.cli.launch import launch
from prism_jax.data.recordings import RecordedCells
from prism_jax.envelope import NOTICE
from prism_jax.envelope.calibration import conformal_margin, read_calibration
from prism_jax.envelope.distance import Envelope
from prism_jax.envelope.files import (
    NAMES,
    distances_summary,
    envelope_files,
    told_kinds,
)
from prism_jax.envelope.recorded import calibrate_on
from prism_jax.envelope.robot import (
    MARGIN,
    of_robot,
    read_joints,
    robot_surface,
)
from prism_jax.envelope.separation import read_terms, separation
from prism_jax.envelope.surfaces import Method, Seen, see, sensor_name
from prism_jax.envelope.voxels import (
    VOXEL,
    Carving,
    Grid,
    carve,
    label,
    view_of_cloud,
    view_of_depth,
)
from prism_jax.geometry.camera import Camera
from prism_jax.observation.support import find_up
from prism_jax.observation.upright import parse_up, upright
from prism_jax.result import plain, software
from prism_jax.robots.urdf import Linkage

FLAGS = flags.FLAGS
NAME = "prism-envelope"
CALIBRATE = "calibrate"
_METHOD = {field.name: field.default for field in dataclasses.fields(Method)}
_CARVING = Carving()
AROUND = 10
"""Voxels beyond the inflated surfaces that a grid reaches to, unless it is given."""

_timed = functools.partial(timed, command=NAME)


def define_flags() -> None:
    """The flags of both uses."""
    flags.DEFINE_string("calibration", None, "What `calibrate` wrote; needed.")
    flags.DEFINE_float("alpha", None, "Share of cells to miss; the calibration's own.")
    flags.DEFINE_bool("scaled", False, "Margins in scales of each point's own error.")
    flags.DEFINE_string("weights", "small-robocell", "Released weights, name or file.")
    flags.DEFINE_string(
        "camera",
        None,
        "JSON of the camera; of a depth image by default the .json of the same name.",
    )
    flags.DEFINE_string(
        "depth",
        None,
        "Of a cloud that is part of what a camera saw: its whole 16-bit depth image, "
        "with --camera. It says what is free.",
    )
    flags.DEFINE_string(
        "eye",
        None,
        "Where the sensor of a cloud stood, x,y,z, if it is not --camera's place. "
        "Without either nothing is known to be free.",
    )
    flags.DEFINE_string(
        "sensor", None, "Name of the sensor; by default that of the camera's image."
    )
    flags.DEFINE_string(
        "workspace",
        None,
        "Box of the voxels, x0,y0,z0,x1,y1,z1, to which the scan is cropped. By "
        "default the surfaces with their margin, and some voxels more.",
    )
    flags.DEFINE_float("voxel", VOXEL, "Side of a voxel, in the input's units.")
    flags.DEFINE_float(
        "carving_margin",
        _CARVING.margin,
        "A voxel is free if what was measured lies so far behind it, at least.",
        lower_bound=0.0,
    )
    flags.DEFINE_float(
        "carving_share",
        _CARVING.share,
        "... on so large a share of the pixels that it covers.",
        lower_bound=0.0,
        upper_bound=1.0,
    )
    flags.DEFINE_string("up", None, "Direction upwards, as prism-complete has it.")
    flags.DEFINE_enum(
        "objects",
        _METHOD["objects"],
        ["one", "auto"],
        "one: all points are objects. auto: supports and walls are set aside.",
    )
    flags.DEFINE_enum(
        "around",
        _METHOD["around"],
        ["everything", "objects"],
        "What of the measured a margin is laid around; objects are the scan without "
        "what was set aside.",
    )
    flags.DEFINE_enum(
        "background", _METHOD["background"], ["unknown", "empty"], "As prism-complete."
    )
    flags.DEFINE_float("density", _METHOD["density"], "As prism-complete.", 0.0)
    flags.DEFINE_bool("adapt", _METHOD["adapt"], "Adapt the network to the scan first.")
    flags.DEFINE_string("urdf", None, "The robot, if it is known: URDF or xacro.")
    flags.DEFINE_string(
        "joints",
        None,
        "JSON of its joint positions; `calibrate` takes those of the recordings.",
    )
    flags.DEFINE_float("robot_margin", MARGIN, "Nearer points are the robot's.", 0.0)
    flags.DEFINE_string("ssm", None, "JSON of the terms of a separation distance.")
    flags.DEFINE_string("query", None, "Cloud of points to tell both distances of.")
    flags.DEFINE_integer("max_points", io.MAX_POINTS, "As prism-complete.", 1)
    flags.DEFINE_string(
        "output_dir", "prism_envelope", "Where the results are written."
    )
    flags.DEFINE_string("output", "calibration.json", "What `calibrate` writes.")


def main(words: Sequence[str] = ()) -> None:
    """Does what the flags and the words beside them ask for."""
    if words and words[0] == CALIBRATE:
        if len(words) != 2:
            raise io.InputError(CALIBRATE, "takes one folder", "name the recordings")
        print(calibrate(words[1]))
        return
    if len(words) != 1:
        remedy = f"give one scan, or: {NAME} {CALIBRATE} RECORDINGS --output=cal.json"
        raise io.InputError(NAME, f"got {len(words)} scans", remedy)
    summary = envelope_of(words[0])
    print(f"notice      {NOTICE}")
    print(f"margin      q = {summary['q']:.4g}, {summary['calibration']['n']} cells")
    volumes = ("not_free", "envelope", "free")
    print(f"volumes     {_told({k: summary['volumes'][k] for k in volumes})}")
    if summary["query"]:
        print(f"query       {_told(summary['query'])}")
    print(f"written     {FLAGS.output_dir}: {', '.join(NAMES)}")


def calibrate(folder: str) -> str:
    """Scores every cell of recordings, writes the calibration, and says what it is."""
    cells = RecordedCells(folder)
    method, robot = _method(), _robot()
    alpha = 0.1 if FLAGS.alpha is None else FLAGS.alpha
    # Too few are known to be so before anything is completed.
    conformal_margin([0.0] * len(set(cells.objects)), alpha)
    io.make_output_dir(pathlib.Path(FLAGS.output).parent)
    completer = load_completer(FLAGS.weights)
    weights = _digest(FLAGS.weights)
    calibration = calibrate_on(
        cells, completer, method, robot, weights, alpha, FLAGS.sensor
    )
    calibration.write(FLAGS.output)
    return (
        f"margin      q = {calibration.margin():.4g} for alpha {alpha:g}, "
        f"{len(calibration.cells)} cells\nnotice      {NOTICE}\n"
        f"written     {FLAGS.output}"
    )


def envelope_of(source: str) -> dict[str, Any]:
    """Makes the envelope of a scan, writes its files, and returns what the JSON says.

    What the user can put right raises InputError, before the weights are loaded if it
    can be known by then.
    """
    seconds: dict[str, float] = {}
    with _timed(f"reading {source}", "read", seconds):
        scan, view = _read(source)
        method, robot = _method(), _robot()
        surface = None
        if robot is not None:
            if FLAGS.joints is None:
                raise io.InputError("--urdf", "is without --joints", "give both")
            surface = robot_surface(robot, *read_joints(FLAGS.joints))
        terms = None if FLAGS.ssm is None else read_terms(FLAGS.ssm)
        asked = None
        if FLAGS.query is not None:
            asked = io.read_points(FLAGS.query, FLAGS.max_points).astype(np.float64)
    if FLAGS.calibration is None:
        remedy = f"make one with {NAME} {CALIBRATE} RECORDINGS"
        raise io.InputError("--calibration", "is missing", remedy)
    sensor = FLAGS.sensor or sensor_name(scan.named)
    if sensor is None:
        raise io.InputError("--sensor", "is missing", "name it as it was calibrated")
    runs = method.setup(_digest(FLAGS.weights), sensor)
    calibration = read_calibration(FLAGS.calibration, runs)
    alpha = calibration.alpha if FLAGS.alpha is None else FLAGS.alpha
    margin = calibration.margin(alpha, FLAGS.scaled)
    folder = io.make_output_dir(FLAGS.output_dir)
    with _timed(f"loading the weights {FLAGS.weights}", "load", seconds):
        completer = load_completer(FLAGS.weights)
    count = f"{len(scan.points):,} points (the first run on a machine also compiles)"
    with _timed(f"completing {count}", "complete", seconds):
        known = surface, scan.everything
        seen = see(completer, scan.points, scan.camera, method, scan.up, *known)
    if seen.fault:
        say(f"nothing is predicted: {seen.fault}", NAME)
    with _timed("carving", "envelope", seconds):
        envelope = _envelope(scan, view, seen, margin, calibration.floor)
        found = None if asked is None else (asked, envelope.query(asked))
    summary = {
        "notice": NOTICE,
        "prism_jax": software(),
        "input": {"file": source, "points": len(scan.points)},
        "weights": FLAGS.weights,
        "weights_sha256": runs.weights,
        "sensor": sensor,
        "settings": dict(runs.settings),
        "calibration": {"file": FLAGS.calibration, "n": len(calibration.cells)},
        "alpha": alpha,
        "q": margin,
        "scaled": FLAGS.scaled,
        "not_completed": seen.fault,
        "grid": {
            "lower": envelope.grid.lower,
            "voxel": envelope.grid.voxel,
            "shape": envelope.grid.shape,
        },
        "carving": {"margin": FLAGS.carving_margin, "share": FLAGS.carving_share},
        "points": told_kinds(envelope),
        "volumes": envelope.volumes(),
        "query": None if found is None else distances_summary(found[1]),
        "separation": None if terms is None else separation(terms, margin),
        "seconds": seconds,
    }
    turn = upright(scan.up)
    vertical = np.array([0.0, 0.0, 1.0]) if turn is None else turn[2]
    with _timed(f"writing to {folder}", "write", seconds):
        files = envelope_files(envelope, plain(summary), scan.named, vertical, found)
        io.write_together({folder / name: data for name, data in files.items()})
    return plain(summary)


@dataclasses.dataclass(frozen=True)
class _Scan:
    """A scan as it was read.

    `points` are completed, `everything` is all that was measured; `camera` stands where
    the sensor did, `named` is the depth camera if there is one.
    """

    points: np.ndarray
    everything: np.ndarray
    camera: Camera | None
    named: Camera | None
    up: Any


def _read(source: str) -> tuple[_Scan, Any]:
    """The scan, and the view that tells what is free, if there is one."""
    bounds = None if FLAGS.workspace is None else io.parse_bounds(FLAGS.workspace)
    direction = None if FLAGS.up is None else parse_up(FLAGS.up)
    scan = io.read_scan(source, FLAGS.camera, max_points=FLAGS.max_points)
    depth = source if source.lower().endswith(".png") else FLAGS.depth
    camera, view, everything = scan.camera, None, scan.points
    if depth is not None:
        camera_path = FLAGS.camera or pathlib.Path(depth).with_suffix(".json")
        metres, mask, camera = io.read_depth(depth, camera_path, FLAGS.max_points)
        view = view_of_depth(metres, mask, camera)
        seen = io.points_from_depth(metres, mask, camera)
        everything = np.concatenate([scan.points, seen])
    named = camera
    if FLAGS.eye is not None:
        if depth is not None:
            raise io.InputError("--eye", "is of a depth image", "leave it out")
        eye = _vector("--eye", FLAGS.eye)
        camera = Camera(np.eye(3), -eye, np.eye(3), 1, 1)
    if view is None and camera is not None:
        view = view_of_cloud(scan.points, np.asarray(camera.position), FLAGS.background)
    if view is None:
        say("nothing is free: give --camera or --eye, the sensor's place", NAME)
    if direction is None:
        direction = "-y" if scan.in_camera_frame else "z"
    if isinstance(direction, str) and direction == "auto":
        place = None if camera is None else np.asarray(camera.position)
        rotation = None if named is None else named.rotation
        direction = find_up(scan.points, place, rotation).vector
    points = io.crop(scan.points, bounds, source)
    return _Scan(points, everything, camera, named, direction), view


def _envelope(
    scan: _Scan, view: Any, seen: Seen, margin: float, floor: float | None
) -> Envelope:
    """The voxels of a scan, its surfaces, and their margin."""
    surfaces = seen.surfaces(floor if FLAGS.scaled else None)
    if FLAGS.workspace is not None:
        bounds = io.parse_bounds(FLAGS.workspace)
        grid = Grid.over(bounds.lower, bounds.upper, FLAGS.voxel)
    else:
        held = np.concatenate([scan.points, seen.predicted, seen.robot])
        reach = surfaces.reach(margin) + AROUND * FLAGS.voxel
        grid = Grid.over(held.min(0) - reach, held.max(0) + reach, FLAGS.voxel)
    free = np.zeros(grid.shape, bool)
    if view is not None:
        carving = Carving(FLAGS.carving_margin, FLAGS.carving_share)
        free = carve(grid, view, carving)
    own = of_robot(scan.everything, seen.robot, FLAGS.robot_margin)
    measured = scan.everything[~own]
    state = label(grid, free, measured, seen.predicted, seen.robot)
    return Envelope(grid, state, surfaces, margin)


def _method() -> Method:
    return Method(
        adapt=FLAGS.adapt,
        density=FLAGS.density,
        background=FLAGS.background,
        objects=FLAGS.objects,
        around=FLAGS.around,
        robot="unknown" if FLAGS.urdf is None else "known",
        robot_margin=FLAGS.robot_margin,
    )


def _robot() -> Linkage | None:
    return None if FLAGS.urdf is None else Linkage(FLAGS.urdf)


def _digest(weights: str) -> str:
    # It imports Flax, which a fault in the input does not wait for.
    from prism_jax.weights import file_sha256

    return file_sha256(weights)


def _vector(flag: str, text: str) -> np.ndarray:
    try:
        vector = np.array([float(word) for word in text.split(",")])
    except ValueError:
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise io.InputError(flag, f"cannot read {text!r}", "give x,y,z")
    return vector


def _told(numbers: dict[str, Any]) -> str:
    return ", ".join(
        f"{name.replace('_', ' ')} {value:.4g}"
        if isinstance(value, float)
        else f"{name.replace('_', ' ')} {value}"
        for name, value in numbers.items()
    )


def run() -> None:
    """The entry point of `prism-envelope`."""
    define_flags()
    launch(NAME, main, takes_words=True)


if __name__ == "__main__":
    run()
