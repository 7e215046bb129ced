"""Builds the simulated RoboArm-Depth recordings of a split.

They stand in for the paper's data set of that name (Sec. IV-A), which is not public:
sequences of frames in the layout of `prism_jax.data.recordings`, each with an L515
depth image, its partial cloud, and an Ouster's complete cloud of robot and fixtures.
"""

import dataclasses
import functools
import hashlib
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.simulation.building import build
from experiments.simulation.recorder import has_frame, write_frame
from experiments.simulation.roboarm.models import OWN, ArmModel, arms_of, urdf_path
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.roboarm.sequences import (
    RoboArmConfig,
    make_frame,
    make_sequence,
)
from prism_jax.data.datasets import DATASETS, ROBOARM_VERSION
from prism_jax.io.errors import InputError, choose

SPLITS = DATASETS["roboarm"].splits
NUM_SEQUENCES, NUM_FRAMES = 20, 10


def build_roboarm(
    split: str,
    output_dir: str | os.PathLike,
    num_sequences: int = NUM_SEQUENCES,
    num_frames: int = NUM_FRAMES,
    seed: int = 0,
    num_workers: int | None = None,
    progress: bool = True,
    config: RoboArmConfig = RoboArmConfig(),
    arms: Sequence[ArmModel] | None = None,
) -> pathlib.Path:
    """Builds what is missing of a split's recordings and returns their folder.

    Sequence i has arm `i % len(arms)`, by default of the split's own.
    """
    choose("split", split, SPLITS)
    arms = tuple(arms_of(split) if arms is None else arms)
    for model in arms:
        urdf_path(model)
    if min(num_sequences, num_frames) < 1 or seed < 0:
        fault = f"{num_sequences} sequences of {num_frames} frames, seed {seed}"
        raise InputError("roboarm", fault, "use at least one of each, and a seed >= 0")
    folder = pathlib.Path(output_dir)
    names = [
        f"{index:03d}-{arms[index % len(arms)].name}" for index in range(num_sequences)
    ]
    content = {
        "generator": "prism_jax roboarm",
        "generator_version": ROBOARM_VERSION,
        "split": split,
        "num_sequences": num_sequences,
        "num_frames": num_frames,
        "seed": seed,
        "config": dataclasses.asdict(config),
        "arms": [_arm_content(model) for model in arms],
    }
    return build(
        folder,
        content,
        [num_frames] * num_sequences,
        lambda index: all(
            has_frame(folder / names[index], number) for number in range(num_frames)
        ),
        functools.partial(
            _build_sequence, split, num_frames, seed, config, arms, folder
        ),
        "frame",
        num_workers,
        progress,
    )


def own_rng(split: str, seed: int, *indices: int) -> np.random.Generator:
    """The generator of a sequence, or of one of its frames; NumPy fills up with zeros,
    so that the first frame's is the sequence's."""
    return np.random.default_rng((seed, SPLITS.index(split), *indices))


def _build_sequence(
    split: str,
    num_frames: int,
    seed: int,
    config: RoboArmConfig,
    arms: Sequence[ArmModel],
    folder: pathlib.Path,
    index: int,
) -> None:
    model = arms[index % len(arms)]
    sequence = folder / f"{index:03d}-{model.name}"
    missing = [n for n in range(num_frames) if not has_frame(sequence, n)]
    if not missing:
        return
    made = make_sequence(model, num_frames, config, own_rng(split, seed, index))
    for number in missing:
        rng = own_rng(split, seed, index, number)
        write_frame(sequence, number, make_frame(made, number, config, rng))


def _arm_content(model: ArmModel) -> dict[str, Any]:
    """What tells an arm from others: the user's own also by its shape and joints."""
    content = dataclasses.asdict(model)
    for name in ("family", "licence", "package"):
        del content[name]
    if model.family == OWN:
        robot = Robot(model)
        ends = robot.link_poses(np.stack([robot.lower, robot.upper]))
        meshes = [a for mesh in robot.meshes for a in (mesh.vertices, mesh.faces)]
        digest = hashlib.sha256()
        for array in (robot.lower, robot.upper, ends, *meshes):
            digest.update(np.ascontiguousarray(array).tobytes())
        content["sha256"] = digest.hexdigest()
    return content
