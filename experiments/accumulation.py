"""What --accumulate gains in cells: python -m experiments.accumulation

Arms of the validation split move through simulated cells and hide what was seen before.
Each frame is completed as prism-stream does it, with and without what earlier frames
measured, and all that a user gets is compared with the true surfaces. Table and boxes
are left out, as --workspace does it, but looked past. It prints a table.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import tqdm
from absl import flags
from jaxtyping import Float
from scipy.spatial import KDTree

from prism_jax.cli.complete import load_completer
from prism_jax.cli.launch import launch
from prism_jax.data.recordings import DEPTH_SCALE
from prism_jax.evaluation.bootstrap import mean_intervals
from prism_jax.io.depth import points_from_depth
from prism_jax.io.errors import InputError, require
from prism_jax.io.streams import Frame
from prism_jax.observation.accumulation import STEADY, Accumulator

FLAGS = flags.FLAGS
FAR = 0.03
"""Metres: a remembered point farther from the truth was of something that has moved."""

TOLD = (
    ("truth to output", "mm"),
    ("output to truth", "mm"),
    ("CD-L1", "mm"),
    ("remembered points", "a frame"),
    ("of these, farther than 3 cm from the truth", "a frame"),
    ("frames with too little to complete", "share"),
)


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "Released weights, name or file.")
    flags.DEFINE_float("voxel", 0.03, "What --accumulate is.", 1e-4)
    flags.DEFINE_integer("num_sequences", 12, "Cells, of the arms in turn.", 2)
    flags.DEFINE_integer("num_frames", 20, "Of each, over one movement.", STEADY + 1)
    flags.DEFINE_integer("width", 320, "Pixels of the depth camera; 4 to 3.", 16)
    flags.DEFINE_integer("seed", 0, "Of everything.", 0)


@dataclasses.dataclass
class Looking(Accumulator):
    """Sees all of a frame, `everything`, where what is completed is a part of it."""

    everything: Float[np.ndarray, "M 3"] | None = None

    def add(self, points, measured, eye):
        everything = measured if self.everything is None else self.everything
        return super().add(points, everything, eye)


def main() -> None:
    """Measures it."""
    for package in ("trimesh", "manifold3d", "embreex", "fpsample"):
        require(package, "data")
    from experiments.simulation.roboarm.models import arms_of

    arms = arms_of("validation")
    completer = load_completer(FLAGS.weights)
    rows, groups = [], []
    total = FLAGS.num_sequences * FLAGS.num_frames
    with tqdm.tqdm(total=total, unit="frame", delay=2.0, disable=None) as bar:
        for number in range(FLAGS.num_sequences):
            frames, robot = _sequence(arms[number % len(arms)], number, bar.update)
            for known in (None, robot):
                for voxel in (None, FLAGS.voxel):
                    rows.append(_scores(completer, frames, known, voxel))
            groups += [number] * (FLAGS.num_frames - STEADY)
    # Robot unknown or known, without memory or with it, frame, score.
    count = FLAGS.num_frames - STEADY
    scores = np.reshape(rows, (-1, 2, 2, count, len(TOLD)))
    scores = scores.transpose(1, 2, 0, 3, 4).reshape(2, 2, -1, len(TOLD))
    print(table(scores, np.array(groups)))


def table(scores: Float[np.ndarray, "2 2 E K"], groups: np.ndarray) -> str:
    """Markdown: means, and the mean change with its interval over whole sequences."""
    lines = [
        "| robot | what | without | with | change (95 %) |",
        "| --- | --- | --- | --- | --- |",
    ]
    for robot, (without, given) in zip(("unknown", "known"), scores, strict=True):
        low, high = mean_intervals(given - without, groups)
        for place, (name, unit) in enumerate(TOLD):
            before, after = without[:, place].mean(), given[:, place].mean()
            lines.append(
                f"| {robot} | {name}, {unit} | {before:.2f} | {after:.2f} | "
                f"{after - before:+.2f} ({low[place]:+.2f} to {high[place]:+.2f}) |"
            )
    return "\n".join(lines)


def score(
    points: Float[np.ndarray, "N 3"],
    remembered: Float[np.ndarray, "R 3"],
    truth: Float[np.ndarray, "M 3"],
) -> list[float]:
    """Of one frame, what `TOLD` names but for the last; given in metres."""
    away = KDTree(truth).query(points)[0].mean()
    missed = KDTree(points).query(truth)[0].mean()
    stale = KDTree(truth).query(remembered)[0] > FAR if len(remembered) else []
    distances = [1e3 * missed, 1e3 * away, 500 * (missed + away)]
    return [*distances, float(len(remembered)), float(np.sum(stale))]


def _sequence(
    model: Any, number: int, tell: Callable[[int], Any]
) -> tuple[list[tuple[Frame, np.ndarray, np.ndarray]], Any]:
    """Frames of robot and fixtures, each with all that was measured in it and the true
    surface, and the robot. A draw of which too little is seen is drawn again."""
    from experiments.simulation.roboarm.sequences import (
        RoboArmConfig,
        make_frame,
        make_sequence,
    )

    config = dataclasses.replace(
        RoboArmConfig(),
        width=FLAGS.width,
        height=FLAGS.width * 3 // 4,
        complete_points=4096,
        num_waypoints=2,
    )

    def frames(rng: np.random.Generator) -> Iterator[Any]:
        sequence = make_sequence(model, FLAGS.num_frames, config, rng)
        base = np.eye(4)
        base[2, 3] = sequence.cell.base_height
        for place in range(FLAGS.num_frames):
            made = make_frame(sequence, place, config, rng)
            metres = made.depth * DEPTH_SCALE
            seen = points_from_depth(metres, made.depth > 0, made.camera)
            joints = {**(made.joints or {}), "base": base.tolist()}
            frame = Frame(made.partial, place * 10**8, made.camera, joints=joints)
            yield sequence.robot, (frame, seen, made.complete)
            if place == FLAGS.num_frames - 1:
                tell(FLAGS.num_frames)

    for attempt in range(20):
        rng = np.random.default_rng([FLAGS.seed, number, attempt])
        try:
            robots, found = zip(*frames(rng), strict=True)
            return list(found), robots[0]
        except ValueError as error:
            fault = error
    raise InputError("--seed", f"cell {number} sees too little: {fault}", "try another")


def _scores(
    completer: Any, frames: list[Any], robot: Any, voxel: float | None
) -> list[list[float]]:
    """Of the frames of one sequence in which something may be remembered."""
    from prism_jax.streams.completer import FrameCompleter

    memory = None if voxel is None else Looking(voxel)
    stream = FrameCompleter(completer, accumulator=memory, robot=robot)
    scores = []
    for frame, everything, truth in frames:
        if memory is not None:
            memory.everything = everything
        try:
            done = stream.complete(frame)
        except InputError:
            # Nearly nothing but the robot is seen, and the user gets nothing new.
            scores.append([*score(frame.points, frame.points[:0], truth), 1.0])
            continue
        observed = done.points[done.observed]
        remembered = observed[len(observed) - done.remembered :]
        scores.append([*score(done.points, remembered, truth), 0.0])
    return scores[STEADY:]


def run() -> None:
    """The entry point."""
    define_flags()
    launch("accumulation", main)


if __name__ == "__main__":
    run()
