"""prism-envelope: which parts of a workspace are occupied, uncertain or free.

    prism-envelope calibrate RECORDINGS [flags]
    prism-envelope reference SCAN or RECORDING [flags]
    prism-envelope SCAN or RECORDING [flags]
    prism-envelope calibrate cells --output=cal.json
    prism-envelope scan.ply --eye=0,0,0 --calibration=cal.json --output_dir=out
    prism-envelope recording.mcap --calibration=cal.json --workspace=-1,-1,0,1,1,2

Not safety-rated; no claim to any standard; people are never predicted. If the input or
the calibration cannot be used, it exits with status 2 and one line on stderr.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from absl import flags
from jaxtyping import Float

from prism_jax import io
from prism_jax.cli import shared_flags
from prism_jax.cli.envelope_output import LINES, Output
from prism_jax.cli.launch import launch, load_completer, load_library, say, timed
from prism_jax.cli.stream import (
    REPORT,
    follow,
    known_camera,
    known_robot,
    progress_bar,
    told_frames,
)
from prism_jax.data.recordings import RecordedCells
from prism_jax.envelope import NOTICE
from prism_jax.envelope.calibration import (
    check_setup,
    conformal_margin,
    read_calibration,
)
from prism_jax.envelope.carving import Carving, View
from prism_jax.envelope.files import NAMES
from prism_jax.envelope.page import told
from prism_jax.envelope.recorded import calibrate_on
from prism_jax.envelope.reference import reference_of
from prism_jax.envelope.robot import (
    joints_from_dict,
    of_robot,
    robot_digest,
    robot_surface,
)
from prism_jax.envelope.surfaces import Input, Method, sensor_name
from prism_jax.envelope.voxels import VOXEL
from prism_jax.io.atomic import PREVIOUS, check_targets, claim, set_aside, write_bytes
from prism_jax.io.clouds import read_cloud, rounding
from prism_jax.io.ply import vertices_bytes
from prism_jax.io.scan import parse_numbers, parted
from prism_jax.io.streams import Joints, Stream, is_stream, open_stream
from prism_jax.io.streams.frame import Frame
from prism_jax.preprocessing.segmentation.support import find_up
from prism_jax.preprocessing.upright import parse_up
from prism_jax.reporting.summary import software
from prism_jax.robots.urdf import Linkage
from prism_jax.streaming import enveloper
from prism_jax.streaming.observer import default_up

FLAGS = flags.FLAGS
NAME = "prism-envelope"
CALIBRATE, REFERENCE = "calibrate", "reference"
_UNUSED = {
    CALIBRATE: "calibration camera depth eye query reference topic pace every_frame "
    "carving_margin smallest_body max_points output_dir",
    REFERENCE: "calibration query reference alpha weights adapt density background "
    "known input sensor voxel up workspace smallest_body pace every_frame output_dir",
    "": "input output",
}
"""Flags that a use refuses."""
_METHOD = Method()
_CARVING = Carving()

_timed = functools.partial(timed, NAME)
_say = functools.partial(say, NAME)


def define_flags() -> None:
    """The flags of both uses."""
    shared_flags.define_strings(
        calibration="File written by `calibrate`; required.",
        camera="Camera as JSON or YAML, or a recording's CameraInfo topic. Default: "
        "the .json of the same name for a depth image, the CameraInfo for a recording.",
        depth="For a cloud cropped from a depth image: the whole 16-bit image, with "
        "--camera. It shows which space is free.",
        eye="Sensor position of a cloud, x,y,z, if it is not --camera's.",
        sensor="Name of the sensor. Default: derived from the camera's image.",
        workspace="Box of the voxels in metres, x0,y0,z0,x1,y1,z1, to which the scan "
        "is cropped. Default: the surfaces with their margin, plus some voxels.",
        reference="Surfaces that stand still, written by `reference`. A scan that "
        "disagrees with them is refused.",
        query="Cloud of points to report both distances for.",
    )
    flags.DEFINE_float(
        "alpha", None, "Share of cells that may be missed. Default: the calibration's."
    )
    shared_flags.define_completion_flags(_METHOD.density)
    shared_flags.define_recording_flags()
    shared_flags.define_max_points(io.MAX_POINTS)
    flags.DEFINE_bool(
        "every_frame",
        False,
        "Write all files for every frame of a recording, each into its own folder; "
        "otherwise only for the last one.",
    )
    flags.DEFINE_float("voxel", VOXEL, "Side of a voxel in metres.")
    flags.DEFINE_float(
        "carving_margin",
        _CARVING.margin,
        "A voxel is free only if everything measured there is at least this far behind "
        "it, and behind a body of --smallest_body: errors of depths and of the pose.",
        lower_bound=0.0,
    )
    flags.DEFINE_float(
        "smallest_body",
        _CARVING.body,
        "Diameter of the smallest ball that free space must not hold, in metres. "
        "Sparse sensors prove nothing free for small ones: see docs/envelope.md.",
        lower_bound=1e-3,
    )
    flags.DEFINE_enum(
        "input",
        None,
        ["both", "depth", "cloud"],
        "What `calibrate` takes of each frame: both (default: the cloud, and the depth "
        "image beside it), depth (the image alone), or cloud (the cloud alone).",
    )
    flags.DEFINE_string("output_dir", "prism_envelope", "Output folder.")
    flags.DEFINE_string(
        "output",
        None,
        "File that `calibrate` or `reference` writes. Default: calibration.json or "
        "reference.ply.",
    )


class _Given(NamedTuple):
    """What the flags say of any scan."""

    eye: Float[np.ndarray, "3"] | None
    bounds: io.Bounds | None
    robot: Linkage | None
    joints: Joints | None
    carving: Carving
    library: Any  # models that are known; None without them


def main(words: Sequence[str] = ()) -> None:
    """Does what the flags and the words beside them ask for."""
    use = words[0] if words and words[0] in (CALIBRATE, REFERENCE) else ""
    named = words[1:] if use else words
    if len(named) != 1:
        fault = f"expected one scan or recording, got {len(named)}"
        remedy = f"write {NAME} SCAN, or {NAME} {CALIBRATE} RECORDINGS"
        raise io.InputError(use or NAME, fault, remedy)
    for name in _UNUSED[use].split():
        if FLAGS[name].present:
            fault = f"not used by {NAME} {use}".strip()
            raise io.InputError(f"--{name}", fault, "omit it")
    if use == CALIBRATE:
        print(calibrate(named[0]))
    elif use == REFERENCE:
        print(make_reference(named[0]))
    else:
        print(_said(named[0], envelope_of(named[0])))


def calibrate(folder: str) -> str:
    """Scores every cell of recordings, writes the calibration, and says what it is."""
    with _timed(f"reading {folder}", "read", {}):
        cells, given = RecordedCells(folder), _given()
    if given.joints is not None and given.joints.topic is not None:
        raise io.InputError("--joints", "not a file", "give a .json file, or omit it")
    method = _method(FLAGS.input or "both", FLAGS.up or "z", given)
    alpha = 0.1 if FLAGS.alpha is None else FLAGS.alpha
    # Too few are known to be so before anything is completed.
    conformal_margin([0.0] * len(set(cells.objects)), alpha)
    output = FLAGS.output or "calibration.json"
    io.make_output_dir(pathlib.Path(output).parent)
    check_targets([output])
    _say(f"{len(cells)} frames; the first run on a machine also compiles")
    completer = load_completer(FLAGS.weights).knowing(given.library)
    weights = _digest(FLAGS.weights)
    known = FLAGS.sensor, given.robot, given.joints or Joints()
    calibration = calibrate_on(cells, completer, method, weights, alpha, *known)
    calibration.write(output)
    return (
        f"margin      q = {calibration.margin():.4g} m for alpha {alpha:g}, "
        f"{len(calibration.cells)} cells\nnotice      {NOTICE}\n"
        f"written     {output}"
    )


def make_reference(source: str) -> str:
    """Writes the surfaces that stand still in a scan, or in all frames of a recording,
    and says how many points they are."""
    given, output = _given(), FLAGS.output or "reference.ply"
    io.make_output_dir(pathlib.Path(output).parent)
    check_targets([output])
    with _timed(f"reading {source}", "read", {}):
        if is_stream(source):
            stream, first = _opened(source, given.joints)
            scanner = enveloper.FrameScanner(
                eye=given.eye,
                sensor=sensor_name(first.camera),
                robot=given.robot,
                robot_margin=FLAGS.robot_margin,
            )
            scans = map(scanner.complete, progress_bar(stream, total=len(stream)))
        else:
            scans = [_read(source, given)[0]]
        points = reference_of(map(_still, scans), given.carving)
    write_bytes(output, vertices_bytes(points))
    return f"reference   {len(points):,} points\nwritten     {output}"


def _still(scan: enveloper.Scanned) -> tuple[View, Float[np.ndarray, "_ 3"]]:
    """A scan's view, and what was measured of anything but a known robot."""
    robot = np.zeros((0, 3)) if scan.robot is None else scan.robot
    own = of_robot(scan.everything, robot, FLAGS.robot_margin)
    return scan.view(), scan.everything[~own]


def envelope_of(source: str) -> dict[str, Any]:
    """Makes the envelope of a scan, or of each frame of a recording; writes the files.
    Returns what the JSON says, of a recording what `stream.json` does. What the user
    can put right raises InputError, if possible before the weights are loaded."""
    seconds: dict[str, float] = {}
    folder = claim(FLAGS.output_dir)
    if set_aside(FLAGS.output_dir, (*NAMES, LINES, REPORT, "[0-9]" * 6)):
        place = pathlib.Path(FLAGS.output_dir) / PREVIOUS
        _say(f"the results of an earlier run are now in {place}")
    given = _given()
    stream = scan = asked = reference = None
    left_out = 0  # of the points that are asked for
    with _timed(f"reading {source}", "read", seconds):
        if is_stream(source):
            stream, first = _opened(source, given.joints)
            camera, up = first.camera, FLAGS.up or default_up(first)
            kind = "cloud" if first.depth is None else "depth"
            if camera is None and given.eye is None:
                raise enveloper.unplaced(source)
        else:
            scan, kind, up = _read(source, given)
            camera = scan.named
            scan.view()
        if FLAGS.query is not None:
            given_query = FLAGS.query, FLAGS.max_points
            asked, num_read, _ = read_cloud(*given_query, are_returns=False)
            left_out = num_read - len(asked)
            if left_out:
                _say(f"{FLAGS.query}: {left_out:,} points are not finite: left out")
        if FLAGS.reference is not None:
            reference = io.read_points(FLAGS.reference).astype(np.float64)
    if FLAGS.calibration is None:
        remedy = f"make one with {NAME} {CALIBRATE} RECORDINGS"
        raise io.InputError("--calibration", "missing", remedy)
    calibration = read_calibration(FLAGS.calibration)
    known = calibration.setup.sensor
    sensor = FLAGS.sensor or sensor_name(camera)
    if sensor is None or FLAGS.sensor not in (None, known):
        fault = "missing" if sensor is None else f"unknown name {sensor!r}"
        remedy = f"the calibration was made for --sensor={known!r}"
        raise io.InputError("--sensor", fault, remedy)
    method = _method(kind, up, given)
    runs = method.setup(_digest(FLAGS.weights), sensor)
    check_setup(calibration, runs, FLAGS.calibration)
    alpha = calibration.alpha if FLAGS.alpha is None else FLAGS.alpha
    margin = calibration.margin(alpha)
    about = {
        "notice": NOTICE,
        "prism_jax": software(),
        "weights": FLAGS.weights,
        "weights_sha256": runs.weights,
        "sensor": sensor,
        "unit": "m",
        "unit_of_volumes": "m3",
        "settings": dict(runs.settings),
        "calibration": {"file": FLAGS.calibration, "n": len(calibration.cells)},
        "query_not_finite": left_out,
        "alpha": alpha,
        "q": margin,
        "carving": given.carving._asdict(),
    }
    with _timed(f"loading the weights {FLAGS.weights}", "load", seconds):
        maker = enveloper.FrameEnveloper(
            completer=load_completer(FLAGS.weights).knowing(given.library),
            method=method,
            calibration=calibration,
            margin=margin,
            sensor=sensor_name(camera),
            carving=given.carving,
            eye=given.eye,
            asked=None if asked is None else asked.astype(np.float64),
            reference=reference,
            robot=given.robot,
            bounds=given.bounds,
            up=parse_up(up),
        )
    output = Output(folder, about, source, FLAGS.every_frame)
    if stream is not None:
        asked_for = {**about, "pace": FLAGS.pace}
        return follow(stream, maker, [output], asked_for, folder / REPORT, _say)
    assert scan is not None
    count = f"{len(scan.points):,} points (the first run on a machine also compiles)"
    with _timed(f"completing {count}", "make", {}):
        made = maker.make(scan)
    if made.seen.fault:
        _say(f"no prediction: {made.seen.fault}")
    made = dataclasses.replace(made, seconds=seconds | made.seconds)
    with _timed(f"writing to {folder}", "write", seconds):
        return output.write_files(folder, made)


def _said(source: str, summary: dict[str, Any]) -> str:
    """What is printed of an envelope, or of a recording's."""
    lines = [f"notice      {NOTICE}"]
    if is_stream(source):
        files = LINES, REPORT, *(["000000/", "..."] if FLAGS.every_frame else NAMES)
        lines.append(told_frames(summary))
    else:
        files, cells = NAMES, summary["calibration"]["n"]
        lines.append(f"margin      q = {summary['q']:.4g} m, {cells} cells")
        names = "not_free", "envelope", "free"
        volumes = {name: summary["volumes"][name] for name in names}
        lines.append(f"volumes     {told(volumes)} (m3)")
        if summary["reference"]:
            lines.append(f"reference   {told(summary['reference'])}")
        if summary["query"]:
            lines.append(f"query       {told(summary['query'])} (m)")
    lines.append(f"written     {FLAGS.output_dir}: {', '.join(files)}")
    return "\n".join(lines)


def _given() -> _Given:
    bounds = None if FLAGS.workspace is None else io.parse_bounds(FLAGS.workspace)
    eye = None
    if FLAGS.eye is not None:
        eye = parse_numbers("--eye", FLAGS.eye, 3, "give x,y,z")
    carving = Carving(FLAGS.carving_margin, FLAGS.smallest_body)
    library = load_library(FLAGS.known, FLAGS.known_unit)
    return _Given(eye, bounds, *known_robot(), carving, library)


def _opened(source: str, joints: Joints | None) -> tuple[Stream, Frame]:
    """The recording, and its first frame."""
    if FLAGS.depth is not None:
        raise io.InputError("--depth", "not supported for recordings", "omit it")
    camera = known_camera()
    stream = open_stream(source, FLAGS.topic, camera, _say, joints)
    # By a second look, so that nothing is told and counted twice.
    looked = open_stream(source, FLAGS.topic, camera, lambda _: None)
    first = next(iter(looked), None)
    if first is None:
        reason = next(iter(looked.told.values()), "the recording has none")
        raise io.InputError(source, "no frames", reason)
    return stream, first


def _read(source: str, given: _Given) -> tuple[enveloper.Scanned, Input, str]:
    """One scan and what its sensor saw beside it, what was measured, and up."""
    if FLAGS.topic is not None:
        raise io.InputError("--topic", "only supported for recordings", "omit it")
    tell = functools.cache(_say)  # once, of files that are read twice
    scan = io.read_scan(source, FLAGS.camera, max_points=FLAGS.max_points, tell=tell)
    if coarse := rounding(scan.points):
        tell(f"{source}: {coarse}")
    kind: Input = "cloud" if FLAGS.depth is None else "both"
    depth_path, camera, depth = FLAGS.depth, scan.camera, None
    if source.lower().endswith(".png"):
        kind, depth_path = "depth", source
    points, around = parted(scan.points, given.bounds, source)
    others = points[:0] if around is None else around
    if depth_path is not None:
        camera_path = FLAGS.camera or pathlib.Path(depth_path).with_suffix(".json")
        image = depth_path, camera_path, FLAGS.max_points, tell
        metres, mask, camera = io.read_depth(*image)
        depth = np.where(mask, metres, 0.0)
        if kind == "both":
            seen = io.points_from_depth(metres, mask, camera)
            others = np.concatenate([others, seen])
    eye = scan.eye if given.eye is None and depth is None else given.eye
    stood = enveloper.standing(depth, camera, eye)
    up = FLAGS.up or ("-y" if scan.in_camera_frame else "z")
    direction = parse_up(up)
    if isinstance(direction, str) and direction == "auto":
        place = None if stood is None else np.asarray(stood.position)
        rotation = None if camera is None else camera.rotation
        direction = find_up(scan.points, place, rotation).vector
    surface = None
    if given.robot is not None:
        held = None if given.joints is None else given.joints.given
        if given.joints is None or held is None:
            fault = "needs --joints, a .json file of joint positions"
            raise io.InputError("--urdf", fault, "set both")
        if given.joints.base is not None:
            held = {**held, "base": given.joints.base}
        posed = joints_from_dict(held, FLAGS.joints, based=True)
        surface = robot_surface(given.robot, *posed, path=FLAGS.joints)
    known = points, others, depth, stood, camera, direction, surface
    return enveloper.Scanned(*known), kind, up


def _method(kind: Input, up: str, given: _Given) -> Method:
    same = "voxel", "adapt", "density", "background"
    box, robot = given.bounds, given.robot
    return Method(
        input=kind,
        up=up,
        workspace=None if box is None else (*box.lower.tolist(), *box.upper.tolist()),
        robot=None if robot is None else robot_digest(robot),
        robot_margin=FLAGS.robot_margin,
        known=None if given.library is None else given.library.digest,
        **{name: getattr(FLAGS, name) for name in same},
    )


def _digest(weights: str) -> str:
    # It imports Flax, which a fault in the input does not wait for.
    from prism_jax.completion.weights import file_sha256

    return file_sha256(weights)


def run() -> None:
    """The entry point of `prism-envelope`."""
    define_flags()
    launch(NAME, main, takes_words=True)


if __name__ == "__main__":
    run()
