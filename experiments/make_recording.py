"""Simulates a recording of a robot cell: python -m experiments.make_recording

Writes recording.mcap, with depth images, CameraInfo and joint states, and a folder
`recording` with the ground truth, and prints the command that completes it.
"""

import dataclasses
import pathlib

import numpy as np
from absl import flags
from tqdm import tqdm

from prism_jax.cli.launch import launch
from prism_jax.io.atomic import make_output_dir
from prism_jax.io.errors import InputError, require

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("output", "recording.mcap", "File to write.")
    flags.DEFINE_string("arm", "panda", "Name of an arm of the test split.")
    flags.DEFINE_integer("num_frames", 20, "Frames of one movement.", 2)
    flags.DEFINE_float("rate", 10.0, "Frames per second.", 0.1)
    flags.DEFINE_integer("width", 640, "Image width in pixels (4:3).", 16)
    flags.DEFINE_integer("complete_points", 4096, "Points of the ground truth.", 64)
    flags.DEFINE_integer("seed", 0, "Random seed.", 0)


def main() -> None:
    """Writes the recording."""
    for package in ("trimesh", "manifold3d", "embreex", "fpsample"):
        require(package, "data")
    from experiments.simulation.roboarm.models import arms_of, urdf_path
    from experiments.simulation.roboarm.recording import record
    from experiments.simulation.roboarm.sequences import (
        RoboArmConfig,
        make_frame,
        make_sequence,
    )

    arms = {arm.name: arm for arm in arms_of("test")}
    if FLAGS.arm not in arms:
        remedy = f"use one of {', '.join(arms)}"
        raise InputError("--arm", f"no such arm {FLAGS.arm!r}", remedy)
    path = FLAGS.output
    if not path.endswith(".mcap"):
        raise InputError(path, "not an .mcap file", "use the suffix .mcap")
    make_output_dir(pathlib.Path(path).parent)
    config = dataclasses.replace(
        RoboArmConfig(),
        width=FLAGS.width,
        height=FLAGS.width * 3 // 4,
        complete_points=FLAGS.complete_points,
        num_waypoints=2,
    )
    rng = np.random.default_rng(FLAGS.seed)
    sequence = make_sequence(arms[FLAGS.arm], FLAGS.num_frames, config, rng)
    numbers = tqdm(range(FLAGS.num_frames), delay=2.0, unit="frame", disable=None)
    frames = (make_frame(sequence, number, config, rng) for number in numbers)
    try:
        beside = record(path, frames, FLAGS.rate)
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError("--seed", str(error), "choose another seed") from None
    bounds = np.concatenate([sequence.cell.lower, sequence.cell.upper])
    box = ",".join(f"{value:.2f}" for value in bounds)
    print(f"written     {path}, and the ground truth in {beside}")
    first = f"{beside}/000/000000"
    print(
        f"complete    prism-stream {path} --camera={first}.camera.json "
        f"--workspace={box}"
    )
    # The file's own root is where the base is, and all of it is seen, of some arms.
    if arms[FLAGS.arm].root is None and arms[FLAGS.arm].tool_link is None:
        urdf = urdf_path(arms[FLAGS.arm])
        print(f"robot       --urdf={urdf} --base={first}.joints.json")


def run() -> None:
    """The entry point."""
    define_flags()
    launch("make_recording", main)


if __name__ == "__main__":
    run()
