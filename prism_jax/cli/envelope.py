"""prism-envelope: which parts of a workspace are occupied, uncertain or free.

    prism-envelope calibrate RECORDINGS --output=cal.json
    prism-envelope SCAN --calibration=cal.json --alpha=0.1 --output_dir=out
    prism-envelope RECORDING --calibration=cal.json --workspace=-1,-1,0,1,1,2

Not safety-rated; no claim to any standard; people are never predicted. If the input or
the calibration cannot be used, it exits with status 2 and one line on stderr.
"""

import dataclasses
import functools
import json
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from absl import flags
from jaxtyping import Float

from prism_jax import io
from prism_jax.cli import shared_flags
from prism_jax.cli.launch import launch, load_completer, say, timed
from prism_jax.cli.stream import (
    REPORT,
    end_as_interrupted,
    follow,
    known_robot,
    told_frames,
)
from prism_jax.data.recordings import RecordedCells
from prism_jax.envelope import NOTICE
from prism_jax.envelope.calibration import conformal_margin, read_calibration
from prism_jax.envelope.carving import Carving
from prism_jax.envelope.files import (
    NAMES,
    distances_summary,
    envelope_files,
    told_kinds,
)
from prism_jax.envelope.recorded import calibrate_on
from prism_jax.envelope.robot import joints_from_dict, robot_surface
from prism_jax.envelope.separation import read_terms, separation
from prism_jax.envelope.surfaces import Method, sensor_name
from prism_jax.envelope.voxels import VOXEL
from prism_jax.geometry.camera import Camera, Vector
from prism_jax.io.errors import unwritable
from prism_jax.io.files import read_bytes
from prism_jax.io.scan import parse_numbers
from prism_jax.io.streams import Joints, Stream, is_stream, open_stream
from prism_jax.preprocessing.segmentation.support import find_up
from prism_jax.preprocessing.upright import parse_up, upright
from prism_jax.reporting.summary import plain, software
from prism_jax.robots.urdf import Linkage
from prism_jax.streaming.enveloper import (
    FrameEnveloper,
    MadeEnvelope,
    Scanned,
    standing,
)

FLAGS = flags.FLAGS
NAME = "prism-envelope"
CALIBRATE = "calibrate"
_METHOD = Method()
_CARVING = Carving()
LINES = "envelope.jsonl"  # of a stream, a line a frame

_timed = functools.partial(timed, NAME)
_say = functools.partial(say, NAME)


def define_flags() -> None:
    """The flags of both uses."""
    shared_flags.define_strings(
        calibration="File written by `calibrate`; required.",
        camera="Camera JSON. Default: the .json of the same name for a depth image, "
        "the CameraInfo for a recording.",
        depth="For a cloud cropped from a depth image: the whole 16-bit image, with "
        "--camera. It shows which space is free.",
        eye="Sensor position of a cloud, x,y,z, if it is not --camera's. Without "
        "either, no space is known to be free.",
        sensor="Name of the sensor. Default: derived from the camera's image.",
        workspace="Box of the voxels, x0,y0,z0,x1,y1,z1, to which the scan is "
        "cropped. Default: the surfaces with their margin, plus some voxels.",
        ssm="JSON with the terms of a separation distance.",
        query="Cloud of points to report both distances for.",
    )
    flags.DEFINE_float(
        "alpha", None, "Share of cells that may be missed. Default: the calibration's."
    )
    flags.DEFINE_bool("scaled", False, "Scale margins by each point's expected error.")
    shared_flags.define_completion_flags(_METHOD.density)
    shared_flags.define_recording_flags()
    shared_flags.define_max_points(io.MAX_POINTS)
    flags.DEFINE_bool(
        "every_frame",
        False,
        "Write all files for every frame of a recording, each into its own folder; "
        "otherwise only for the last one.",
    )
    flags.DEFINE_float("voxel", VOXEL, "Side of a voxel, in input units.")
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
        "Diameter of the smallest ball that free space must not hold, in input units. "
        "Sparse sensors prove nothing free for small ones: see docs/envelope.md.",
        lower_bound=1e-3,
    )
    flags.DEFINE_enum(
        "objects",
        _METHOD.objects,
        ["one", "auto"],
        "one: all points belong to objects. auto: remove supports and walls.",
    )
    flags.DEFINE_enum(
        "around",
        _METHOD.around,
        ["everything", "objects"],
        "Measured points that get a margin: all, or only those on objects (not on "
        "removed supports and walls).",
    )
    flags.DEFINE_string("output_dir", "prism_envelope", "Output folder.")
    flags.DEFINE_string("output", "calibration.json", "File that `calibrate` writes.")


def main(words: Sequence[str] = ()) -> None:
    """Does what the flags and the words beside them ask for."""
    if words and words[0] == CALIBRATE:
        if len(words) != 2:
            fault = f"expected one folder, got {len(words) - 1}"
            raise io.InputError(CALIBRATE, fault, "give the folder of recordings")
        print(calibrate(words[1]))
        return
    if len(words) != 1:
        fault = f"expected one scan or recording, got {len(words)}"
        remedy = f"write {NAME} SCAN, or {NAME} {CALIBRATE} RECORDINGS"
        raise io.InputError(NAME, fault, remedy)
    end_as_interrupted()
    summary = envelope_of(words[0])
    print(f"notice      {NOTICE}")
    if is_stream(words[0]):
        files = LINES, REPORT, *(["000000/", "..."] if FLAGS.every_frame else NAMES)
        print(told_frames(summary))
        print(f"written     {FLAGS.output_dir}: {', '.join(files)}")
        return
    print(f"margin      q = {summary['q']:.4g}, {summary['calibration']['n']} cells")
    volumes = ("not_free", "envelope", "free")
    print(f"volumes     {_told({k: summary['volumes'][k] for k in volumes})}")
    if summary["query"]:
        print(f"query       {_told(summary['query'])}")
    print(f"written     {FLAGS.output_dir}: {', '.join(NAMES)}")


def calibrate(folder: str) -> str:
    """Scores every cell of recordings, writes the calibration, and says what it is."""
    cells = RecordedCells(folder)
    method = _method()
    robot = None if FLAGS.urdf is None else Linkage(FLAGS.urdf)
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
    """Makes the envelope of a scan, or of each frame of a recording; writes the files.
    Returns what the JSON says, of a recording what `stream.json` does. What the user
    can put right raises InputError, if possible before the weights are loaded."""
    seconds: dict[str, float] = {}
    method = _method()
    bounds = None if FLAGS.workspace is None else io.parse_bounds(FLAGS.workspace)
    up = None if FLAGS.up is None else parse_up(FLAGS.up)
    eye = None
    if FLAGS.eye is not None:
        eye = parse_numbers("--eye", FLAGS.eye, 3, "give x,y,z")
    stream = scan = asked = None
    with _timed(f"reading {source}", "read", seconds):
        robot, joints = known_robot()
        if is_stream(source):
            stream, named = _opened(source, joints)
        else:
            scan = _read(source, eye, bounds, up, robot, joints)
            named = scan.named
        if named is None and FLAGS.eye is None:
            _say("no space is known to be free: set --camera or --eye")
        terms = None if FLAGS.ssm is None else read_terms(FLAGS.ssm)
        if FLAGS.query is not None:
            asked = io.read_points(FLAGS.query, FLAGS.max_points).astype(np.float64)
    if FLAGS.calibration is None:
        remedy = f"make one with {NAME} {CALIBRATE} RECORDINGS"
        raise io.InputError("--calibration", "missing", remedy)
    sensor = FLAGS.sensor or sensor_name(named)
    if sensor is None:
        read_bytes(FLAGS.calibration)  # whose absence is the first fault
        raise io.InputError("--sensor", "missing", "use the calibration's sensor")
    runs = method.setup(_digest(FLAGS.weights), sensor)
    calibration = read_calibration(FLAGS.calibration, runs)
    alpha = calibration.alpha if FLAGS.alpha is None else FLAGS.alpha
    margin = calibration.margin(alpha, FLAGS.scaled)
    carving = Carving(FLAGS.carving_margin, FLAGS.smallest_body)
    about = {
        "notice": NOTICE,
        "prism_jax": software(),
        "weights": FLAGS.weights,
        "weights_sha256": runs.weights,
        "sensor": sensor,
        "settings": dict(runs.settings),
        "calibration": {"file": FLAGS.calibration, "n": len(calibration.cells)},
        "alpha": alpha,
        "q": margin,
        "scaled": FLAGS.scaled,
        "carving": carving._asdict(),
        "separation": None if terms is None else separation(terms, margin),
    }
    folder = io.make_output_dir(FLAGS.output_dir)
    with _timed(f"loading the weights {FLAGS.weights}", "load", seconds):
        maker = FrameEnveloper(
            load_completer(FLAGS.weights),
            method,
            margin,
            floor=calibration.floor if FLAGS.scaled else None,
            voxel=FLAGS.voxel,
            carving=carving,
            eye=eye,
            asked=asked,
            robot=robot,
            bounds=bounds,
            up=up,
        )
    if stream is not None:
        sink = _Folder(folder, functools.partial(_summary, about, source))
        told = {**about, "pace": FLAGS.pace}
        return follow(stream, maker, [sink], told, folder / REPORT, _say)
    assert scan is not None
    count = f"{len(scan.points):,} points (the first run on a machine also compiles)"
    with _timed(f"completing {count}", "make", {}):
        made = maker.make(scan)
    if made.seen.fault:
        _say(f"no prediction: {made.seen.fault}")
    seconds |= made.seconds
    summary = _summary(about, source, dataclasses.replace(made, seconds=seconds))
    with _timed(f"writing to {folder}", "write", seconds):
        _write(folder, made, summary)
    return summary


def _summary(about: dict[str, Any], source: str, made: MadeEnvelope) -> dict[str, Any]:
    """What the JSON says of one envelope, `about` being the same for all."""
    grid, query = made.envelope.grid, made.query
    frame = {"frame": made.number, "timestamp": made.timestamp}
    return plain(
        {
            **about,
            "input": {
                "file": source,
                "points": len(made.scan.points),
                **({} if made.number is None else frame),
            },
            "not_completed": made.seen.fault,
            "grid": {"lower": grid.lower, "voxel": grid.voxel, "shape": grid.shape},
            "points": told_kinds(made.envelope),
            "volumes": made.envelope.volumes(),
            "query": None if query is None else distances_summary(query[1]),
            "seconds": made.seconds,
        }
    )


def _write(folder: pathlib.Path, made: MadeEnvelope, summary: dict[str, Any]) -> None:
    """All files of one envelope."""
    turn = upright(made.scan.up)
    vertical = np.array([0.0, 0.0, 1.0]) if turn is None else turn[2]
    about = summary, made.scan.named, vertical, made.query
    files = envelope_files(made.envelope, *about)
    io.write_together({folder / name: data for name, data in files.items()})


class _Folder:
    """A sink: a line for each frame as it comes, and all files of the last, or of each.
    Until it is closed the lines' file ends in `.part.jsonl`."""

    def __init__(
        self, folder: pathlib.Path, summary: Callable[[MadeEnvelope], dict[str, Any]]
    ):
        self._folder, self._summary = folder, summary
        self._last: MadeEnvelope | None = None
        self._part = folder / LINES.replace(".", ".part.")
        self._part.write_bytes(b"")

    def write(self, frame: MadeEnvelope) -> None:
        summary, self._last = self._summary(frame), frame
        told = ("points", "volumes", "q", "query", "not_completed", "seconds")
        line = {"frame": frame.number, "timestamp": frame.timestamp}
        line |= {name: summary[name] for name in told}
        try:
            with open(self._part, "a") as file:
                file.write(json.dumps(line, allow_nan=False) + "\n")
        except OSError as error:
            raise unwritable(self._part, error) from None
        if FLAGS.every_frame:
            own = io.make_output_dir(self._folder / f"{frame.number:06d}")
            _write(own, frame, summary)

    def close(self) -> None:
        if self._last is not None and not FLAGS.every_frame:
            _write(self._folder, self._last, self._summary(self._last))
        os.replace(self._part, self._folder / LINES)


def _opened(source: str, joints: Joints | None) -> tuple[Stream, Camera | None]:
    """The recording, and the camera of its first frame."""
    if FLAGS.depth is not None:
        raise io.InputError("--depth", "not supported for recordings", "omit it")
    camera = None if FLAGS.camera is None else io.read_camera(FLAGS.camera)
    stream = open_stream(source, FLAGS.topic, camera, _say, joints)
    # By a second look, so that nothing is told and counted twice.
    looked = open_stream(source, FLAGS.topic, camera, lambda _: None)
    first = next(iter(looked), None)
    return stream, None if first is None else first.camera


def _read(
    source: str,
    eye: Float[np.ndarray, "3"] | None,
    bounds: io.Bounds | None,
    up: str | Vector | None,
    robot: Linkage | None,
    joints: Joints | None,
) -> Scanned:
    """One scan, and what its sensor saw beside it."""
    if FLAGS.topic is not None:
        raise io.InputError("--topic", "only supported for recordings", "omit it")
    scan = io.read_scan(source, FLAGS.camera, max_points=FLAGS.max_points)
    depth_path = source if source.lower().endswith(".png") else FLAGS.depth
    camera, depth, everything = scan.camera, None, scan.points
    if depth_path is not None:
        camera_path = FLAGS.camera or pathlib.Path(depth_path).with_suffix(".json")
        metres, mask, camera = io.read_depth(depth_path, camera_path, FLAGS.max_points)
        seen = io.points_from_depth(metres, mask, camera)
        everything = np.concatenate([scan.points, seen])
        depth = np.where(mask, metres, 0.0)
    stood = standing(depth, camera, eye)
    if up is None:
        up = "-y" if scan.in_camera_frame else "z"
    if isinstance(up, str) and up == "auto":
        place = None if stood is None else np.asarray(stood.position)
        rotation = None if camera is None else camera.rotation
        up = find_up(scan.points, place, rotation).vector
    surface = None
    if robot is not None and joints is not None:
        if joints.given is None:
            fault = "needs --joints, a .json file of joint positions"
            raise io.InputError("--urdf", fault, "set both")
        base = {} if joints.base is None else {"base": joints.base}
        surface = robot_surface(robot, *joints_from_dict({**joints.given, **base}))
    points = io.crop(scan.points, bounds, source)
    return Scanned(points, everything, depth, stood, camera, up, surface)


def _method() -> Method:
    same = ("adapt", "density", "background", "objects", "around", "robot_margin")
    robot = "unknown" if FLAGS.urdf is None else "known"
    return Method(robot=robot, **{name: getattr(FLAGS, name) for name in same})


def _digest(weights: str) -> str:
    # It imports Flax, which a fault in the input does not wait for.
    from prism_jax.completion.weights import file_sha256

    return file_sha256(weights)


def _told(numbers: dict[str, Any]) -> str:
    told = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in numbers.items()}
    return ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in told.items())


def run() -> None:
    """The entry point of `prism-envelope`."""
    define_flags()
    launch(NAME, main, takes_words=True)


if __name__ == "__main__":
    run()
