"""prism-stream: completes the frames of a recording, at up to the sensor's rate.

    prism-stream RECORDING [flags]
    prism-stream recording.mcap --workspace=-1,-1,0,1,1,2 --output=completed.mcap

A recording is a ROS bag (.bag, .db3, .mcap), a folder of clouds or depth images, or an
Ouster's .pcap or .osf. Each frame is completed as one object: crop it to that.
If the recording cannot be used, it exits with status 2 and one line on stderr. After
Ctrl-C the frames completed so far are saved, and the status is 130.
"""

import functools
import json
import pathlib
import signal
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

from absl import flags
from tqdm import tqdm

from prism_jax import io
from prism_jax.cli import shared_flags
from prism_jax.cli.launch import PATIENCE, launch, load_completer, load_library, say
from prism_jax.envelope.robot import LAYOUT, joints_from_dict
from prism_jax.io.atomic import check_targets, claim, write_bytes
from prism_jax.io.errors import require
from prism_jax.io.files import read_json
from prism_jax.io.streams import Joints, Stream, open_stream
from prism_jax.io.streams.messages import EXTRA
from prism_jax.io.streams.sinks import Sink, open_sink
from prism_jax.models.config import MAX_POSES
from prism_jax.preprocessing.upright import parse_up
from prism_jax.reporting.summary import plain
from prism_jax.robots.urdf import Linkage

FLAGS = flags.FLAGS
NAME = "prism-stream"
REPORT = "stream.json"
_TOLD = "camera workspace weights adapt up density background poses urdf joints base "
_TOLD += "robot_margin robot_speed pace known known_unit"
"""Flags that the report repeats."""
_REASONS = "unusable", "damaged", "cut"  # remarks that tell why there is no frame
_say = functools.partial(say, NAME)
progress_bar = functools.partial(tqdm, unit="frame", delay=PATIENCE, disable=None)


def define_flags() -> None:
    """The flags."""
    shared_flags.define_strings(
        camera="JSON of the pinhole camera and its pose, or a CameraInfo topic. "
        "Replaces the CameraInfo of depth images; sets the sensor position of clouds.",
        workspace="Box to crop each frame to, x0,y0,z0,x1,y1,z1 in metres.",
    )
    shared_flags.define_recording_flags()
    shared_flags.define_completion_flags(density=0.0)
    flags.DEFINE_integer(
        "poses",
        1,
        "Number of poses in which each frame is completed. 1 is fastest; "
        "prism-complete uses the number that the weights set.",
        1,
        MAX_POSES,
    )
    flags.DEFINE_string(
        "output",
        "prism_stream",
        "Completed frames: a file that ends in .mcap, or a folder for PLYs.",
    )


def known_robot() -> tuple[Linkage | None, Joints | None]:
    """The robot of the flags, and where its joint positions come from."""
    joints = FLAGS.joints
    if FLAGS.urdf is None:
        if joints is not None:
            raise io.InputError("--joints", "needs a robot", "set --urdf too")
        return None, None
    given = pose = None
    if joints and (joints.endswith(".json") or pathlib.Path(joints).is_file()):
        given = read_json(joints, LAYOUT)
        joints_from_dict(given, joints)
    if FLAGS.base is not None:
        content = read_json(FLAGS.base, LAYOUT)
        pose = joints_from_dict({"positions": {}} | content, FLAGS.base)[1].tolist()
    robot, topic = Linkage(FLAGS.urdf), None if given else joints
    gap = FLAGS.robot_margin / FLAGS.robot_speed
    return robot, Joints(topic, given, pose, gap, FLAGS.robot_speed, robot.joints)


def known_camera() -> str | None:
    """The camera of the flags as `open_stream` takes it: a file, or a topic."""
    given = FLAGS.camera
    if given and (pathlib.Path(given).is_file() or not given.startswith("/")):
        io.read_camera(given, lambda _: None)  # the file may be no camera
    return given


def main(words: Sequence[str]) -> None:
    """Does what the flags ask for."""
    end_as_interrupted()
    if len(words) != 1:
        fault = f"expected one recording, got {len(words)}"
        raise io.InputError("input", fault, f"write {NAME} RECORDING --output=PATH")
    print(told_frames(stream_file(words[0])))
    if FLAGS.workspace is None:
        print("completed   each whole frame as one object; --workspace crops it to one")
    print(f"written     {FLAGS.output} and {REPORT}")
    if FLAGS.output.lower().endswith(".mcap"):
        print("to view     open it in Foxglove, or in RViz with `ros2 bag play`")
    else:
        print("to view     open the PLY files in CloudCompare or MeshLab")


def stream_file(source: str) -> dict[str, Any]:
    """Completes a recording as the flags say. Returns the content of `stream.json`,
    which is written last, beside an MCAP file or into the folder, also when the stream
    is broken off. What the user can put right raises an InputError, if possible before
    the weights are loaded."""
    bounds = None if FLAGS.workspace is None else io.parse_bounds(FLAGS.workspace)
    direction = None if FLAGS.up is None else parse_up(FLAGS.up)
    camera = known_camera()
    place = pathlib.Path(FLAGS.output)
    beside = place.suffix.lower() == ".mcap"
    report_path = place.with_name(REPORT) if beside else place / REPORT
    if pathlib.Path(source).resolve() == place.resolve():
        fault = "this is the recording itself"
        raise io.InputError(FLAGS.output, fault, "choose another output")
    check_targets([place, report_path] if beside else [report_path])
    robot, positions = known_robot()
    library = load_library(FLAGS.known, FLAGS.known_unit)
    stream = open_stream(source, FLAGS.topic, camera, _say, positions)
    claim(report_path.parent)
    if beside:
        require("mcap.writer", EXTRA)
    # Imported this late, so that a wrong recording is refused in a moment.
    from prism_jax.streaming.completer import FrameCompleter

    completer = FrameCompleter(
        load_completer(FLAGS.weights).knowing(library),
        bounds=bounds,
        adapt=FLAGS.adapt,
        up=direction,
        density=FLAGS.density,
        background=FLAGS.background,
        poses=FLAGS.poses,
        robot=robot,
        robot_margin=FLAGS.robot_margin,
    )
    asked = {name: getattr(FLAGS, name) for name in _TOLD.split()}
    return follow(stream, completer, [open_sink(place)], asked, report_path, _say)


def follow(
    stream: Stream,
    completer: Any,
    sinks: Sequence[Sink],
    asked: Mapping[str, Any],
    report_path: pathlib.Path,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """Runs a stream with a bar of progress, and writes and returns what the report
    says of it, also when it is broken off. No completed frame is an InputError."""
    from prism_jax.streaming.run import StreamReport, run_stream

    report = StreamReport()
    whole = False
    end_as_interrupted()
    tell(f"{len(stream)} frames; the first run on a machine also compiles")
    try:
        bar = progress_bar(total=len(stream))
        progress = SimpleNamespace(write=lambda _: bar.update(), close=bar.close)
        every: list[Any] = [*sinks, progress]
        run_stream(stream, completer, every, asked["pace"], report)
        whole = True
    finally:
        summary = plain(_summary(asked, stream, report) | {"whole": whole})
        text = json.dumps(summary, indent=2, allow_nan=False)
        write_bytes(report_path, f"{text}\n".encode())
    for number, one in report.known.items():
        if one["moved"]:
            tell(f"frame {number}: {one['model']} moved by {one['moved']:.3g} m")
    if asked.get("known") and not report.known:
        tell("no frame holds a known model: check where its sensor stood (--camera)")
    if not report.completed:
        told = [stream.told[kind] for kind in _REASONS if kind in stream.told]
        reason = told[0] if told else "the recording has none"
        raise io.InputError(stream.path, "no frame was completed", reason)
    return summary


def _summary(asked: Mapping[str, Any], stream: Stream, report: Any) -> dict[str, Any]:
    """What `stream.json` says of a stream, whole or broken off."""
    counted = ("completed", "dropped", "unusable")
    frames = {name: getattr(report, name) for name in counted}
    rate = report.completed / report.duration if report.duration else 0.0
    return {
        "source": stream.path,
        "topic": stream.topic,
        "frame_id": stream.frame_id or None,
        **asked,
        "frames": {"in_recording": len(stream), **frames},
        "remarks": dict(stream.remarks),
        "joints_skew": stream.skew,
        "frames_a_second": rate,
        "milliseconds": report.latency(),
        "seconds": {"warm_up": report.warm_up, "stream": report.duration},
        "timestamps": report.timestamps,
        "known": report.known,
    }


def told_frames(summary: dict[str, Any]) -> str:
    """How many frames there were, and how long they took."""
    frames = summary["frames"]
    counts = ", ".join(f"{frames[k]} {k}" for k in ("completed", "dropped", "unusable"))
    lines = [f"frames      {counts}, {summary['frames_a_second']:.1f} a second"]
    for stage, ms in summary["milliseconds"].items():
        times = ", ".join(f"{name} {value:.1f}" for name, value in ms.items())
        lines.append(f"{stage:<11} {times} ms")
    return "\n".join(lines)


def end_as_interrupted() -> None:
    """Has a signal to end break off the stream as Ctrl-C does, so that all files are
    whole."""
    if signal.getsignal(signal.SIGTERM) != signal.SIG_IGN:
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def run() -> None:
    """The entry point of `prism-stream`."""
    define_flags()
    launch(NAME, main, takes_words=True)


if __name__ == "__main__":
    run()
