"""prism-stream: completes the frames of a recording, at up to the sensor's rate.

    prism-stream recording.mcap --output=completed.mcap
    prism-stream scans/ --workspace=-1,-1,0,1,1,2 --pace=sensor --output=completed

If the recording cannot be used, it exits with status 2 and one line on stderr. After
Ctrl-C the frames completed so far are saved, and the status is 130.
"""

import json
import pathlib
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from absl import flags

from prism_jax import io
from prism_jax.cli.launch import launch
from prism_jax.envelope.robot import LAYOUT, ROBOT_MARGIN, joints_from_dict
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import require
from prism_jax.io.files import read_json
from prism_jax.io.streams import Joints, Stream, open_stream
from prism_jax.io.streams.packed import EXTRA
from prism_jax.io.streams.sinks import Sink, open_sink
from prism_jax.models.config import MAX_POSES
from prism_jax.preprocessing.upright import parse_up
from prism_jax.reporting.summary import plain
from prism_jax.robots.urdf import Linkage

FLAGS = flags.FLAGS
NAME = "prism-stream"
REPORT = "stream.json"


def define_flags() -> None:
    """The flags."""
    flags.DEFINE_string(
        "topic", None, "Topic or sensor to read, if the recording has several."
    )
    flags.DEFINE_string(
        "camera",
        None,
        "JSON of the pinhole camera and its pose. Replaces the CameraInfo of depth "
        "images; sets the sensor position of clouds.",
    )
    flags.DEFINE_string(
        "workspace", None, "Box to crop each frame to, x0,y0,z0,x1,y1,z1 in metres."
    )
    flags.DEFINE_string("weights", "small", "Released weights, name or file.")
    flags.DEFINE_bool("adapt", False, "Adapt the network to each frame first.")
    flags.DEFINE_string(
        "up",
        None,
        "Up direction: x, y, z, -x, -y, -z, three numbers x,y,z, or auto: estimated "
        "from the first frame. Default: -y for depth images in their camera's own "
        "axes, z for others.",
    )
    flags.DEFINE_float(
        "density",
        0.0,
        "Density of added points relative to measured ones; 0 keeps the predicted "
        "points as they are, which is fastest.",
        lower_bound=0.0,
    )
    flags.DEFINE_enum(
        "background",
        "unknown",
        ["unknown", "empty"],
        "empty: the sensor saw nothing else nearby, so no points are added there.",
    )
    flags.DEFINE_integer(
        "poses",
        1,
        "Number of poses in which each frame is completed. 1 is fastest; "
        "prism-complete uses the number that the weights set.",
        1,
        MAX_POSES,
    )
    define_robot_flags("the positions recorded with each frame")
    flags.DEFINE_enum(
        "pace",
        "max",
        ["max", "sensor"],
        "max: as fast as possible. sensor: at the recorded rate; late frames are "
        "dropped.",
    )
    flags.DEFINE_string(
        "output",
        "prism_stream",
        "Completed frames: a file that ends in .mcap, or a folder for PLYs.",
    )


def define_robot_flags(otherwise: str) -> None:
    """Those of a robot that is known; `otherwise` its joints are what that says."""
    flags.DEFINE_string("urdf", None, "The robot, if known: URDF or xacro.")
    flags.DEFINE_string(
        "joints",
        None,
        "Joint positions of the robot: a .json file, or a JointState topic of the "
        f"recording. Default: {otherwise}.",
    )
    flags.DEFINE_string(
        "base",
        None,
        'JSON with the robot base pose in the frame of the points ("base", 4x4). '
        "Default: the pose given with the joints, else the identity.",
    )
    flags.DEFINE_float(
        "robot_margin",
        ROBOT_MARGIN,
        "Points nearer to the robot belong to it.",
        lower_bound=0.0,
    )


def known_robot(
    urdf: str | None, joints: str | None, base: str | None
) -> tuple[Linkage | None, Joints | None]:
    """The robot of these flags, and where its joint positions come from."""
    if urdf is None:
        if joints is not None:
            raise io.InputError("--joints", "needs a robot", "set --urdf too")
        return None, None
    given = topic = None
    if joints is not None and (
        joints.endswith(".json") or pathlib.Path(joints).is_file()
    ):
        given = read_json(joints, LAYOUT)
        joints_from_dict(given, joints)
    else:
        topic = joints
    pose = None
    if base is not None:
        content = read_json(base, LAYOUT)
        pose = joints_from_dict({"positions": {}} | content, base)[1].tolist()
    return Linkage(urdf), Joints(topic, given, pose)


def main(words: Sequence[str]) -> None:
    """Does what the flags ask for."""
    if len(words) != 1:
        fault = f"expected one recording, got {len(words)}"
        raise io.InputError("input", fault, f"write {NAME} RECORDING --output=PATH")
    end_as_interrupted()
    summary = stream_file(
        words[0],
        topic=FLAGS.topic,
        camera=FLAGS.camera,
        workspace=FLAGS.workspace,
        weights=FLAGS.weights,
        adapt=FLAGS.adapt,
        up=FLAGS.up,
        density=FLAGS.density,
        background=FLAGS.background,
        poses=FLAGS.poses,
        urdf=FLAGS.urdf,
        joints=FLAGS.joints,
        base=FLAGS.base,
        robot_margin=FLAGS.robot_margin,
        pace=FLAGS.pace,
        output=FLAGS.output,
    )
    print(outcome(summary, FLAGS.output))


def stream_file(
    source: str,
    *,
    topic: str | None = None,
    camera: str | None = None,
    workspace: str | None = None,
    weights: str = "small",
    adapt: bool = False,
    up: str | None = None,
    density: float = 0.0,
    background: str = "unknown",
    poses: int = 1,
    urdf: str | None = None,
    joints: str | None = None,
    base: str | None = None,
    robot_margin: float = ROBOT_MARGIN,
    pace: str = "max",
    output: str = "prism_stream",
) -> dict[str, Any]:
    """Completes a recording; the arguments are the flags of the command.

    Returns the content of `stream.json`, which is written last, beside an MCAP file or
    into the folder, also when the stream is broken off. Everything the user can put
    right raises an InputError, and all that can be known to be wrong does so before the
    weights are loaded.
    """
    asked = {
        "camera": camera,
        "workspace": workspace,
        "weights": weights,
        "adapt": adapt,
        "up": up,
        "density": density,
        "background": background,
        "poses": poses,
        "urdf": urdf,
        "joints": joints,
        "base": base,
        "robot_margin": robot_margin,
        "pace": pace,
    }
    bounds = None if workspace is None else io.parse_bounds(workspace)
    direction = None if up is None else parse_up(up)
    view = None if camera is None else io.read_camera(camera)
    place = pathlib.Path(output)
    beside = place.suffix.lower() == ".mcap"
    report_path = place.with_name(REPORT) if beside else place / REPORT
    if pathlib.Path(source).resolve() == place.resolve():
        raise io.InputError(
            output, "this is the recording itself", "choose another output"
        )
    robot, positions = known_robot(urdf, joints, base)
    stream = open_stream(source, topic, view, say, positions)
    io.make_output_dir(place.parent if beside else place)
    if beside:
        require("mcap.writer", EXTRA)
    # Imported this late, so that a wrong recording is refused in a moment.
    from prism_jax.cli.complete import load_completer
    from prism_jax.streaming.completer import FrameCompleter

    completer: Any = FrameCompleter(
        load_completer(weights),
        bounds=bounds,
        adapt=adapt,
        up=direction,
        density=density,
        background=background,  # pyright: ignore
        poses=poses,
        robot=robot,
        robot_margin=robot_margin,
    )
    return follow(stream, completer, [open_sink(place)], asked, report_path, say)


def follow(
    stream: Stream,
    completer: Any,
    sinks: Sequence[Sink],
    asked: Mapping[str, Any],
    report_path: pathlib.Path,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """Runs a stream with a bar of progress, and writes and returns what the report
    says of it, also when it is broken off."""
    from prism_jax.streaming.run import StreamReport, run_stream

    report = StreamReport()
    whole = False
    tell(f"{len(stream)} frames; the first run on a machine also compiles")
    pace = asked.get("pace", "max")
    try:
        with _progress(len(stream)) as progress:
            run_stream(stream, completer, [*sinks, progress], pace, report)
        whole = True
    finally:
        summary = _summary(asked, stream, report) | {"whole": whole}
        text = json.dumps(plain(summary), indent=2, allow_nan=False)
        write_bytes(report_path, f"{text}\n".encode())
    return plain(summary)


def _summary(asked: Mapping[str, Any], stream: Stream, report: Any) -> dict[str, Any]:
    """What `stream.json` says of a stream, whole or broken off."""
    frames = {
        "in_recording": len(stream),
        "completed": report.completed,
        "dropped": report.dropped,
        "unusable": report.unusable,
    }
    rate = report.completed / report.duration if report.duration else 0.0
    return {
        "source": stream.path,
        "topic": stream.topic,
        **asked,
        "frames": frames,
        "remarks": dict(stream.remarks),
        "frames_a_second": rate,
        "milliseconds": report.latency(),
        "seconds": {"warm_up": report.warm_up, "stream": report.duration},
    }


def outcome(summary: dict[str, Any], output: str) -> str:
    """What was done, in a few lines."""
    return f"{told_frames(summary)}\nwritten     {output} and {REPORT}"


def told_frames(summary: dict[str, Any]) -> str:
    """How many frames there were, and how long they took."""
    frames = summary["frames"]
    counts = ", ".join(f"{frames[k]} {k}" for k in ("completed", "dropped", "unusable"))
    lines = [f"frames      {counts}, {summary['frames_a_second']:.1f} a second"]
    for stage, ms in summary["milliseconds"].items():
        times = ", ".join(f"{name} {value:.1f}" for name, value in ms.items())
        lines.append(f"{stage:<11} {times} ms")
    return "\n".join(lines)


def say(text: str) -> None:
    """One line to the user, on stderr."""
    print(f"{NAME}: {text}", file=sys.stderr, flush=True)


def end_as_interrupted() -> None:
    """Has a signal to end do what Ctrl-C does, so that all files are whole."""

    def end(*_: Any) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, end)


class _progress:
    """A bar on stderr that counts frames as they are written."""

    def __init__(self, total: int):
        from tqdm import tqdm

        self._bar = tqdm(total=total, unit="frame", delay=2.0, disable=None)
        self._start = time.perf_counter()

    def write(self, frame: Any) -> None:
        self._bar.update()

    def close(self) -> None:
        self._bar.close()

    def __enter__(self) -> "_progress":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


def run() -> None:
    """The entry point of `prism-stream`."""
    define_flags()
    launch(NAME, main, takes_words=True)


if __name__ == "__main__":
    run()
