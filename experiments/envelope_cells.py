"""Simulated cells with all that is true of them, to measure envelopes on.

A cell is one frame of its own sequence of `experiments.simulation.roboarm`: another
arm's way, other fixtures, another camera. It is made once and kept.
"""

import functools
import io
import multiprocessing
import pathlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import tqdm
from jaxtyping import Float32, Float64

from experiments.simulation.roboarm.build import own_rng
from experiments.simulation.roboarm.models import arms_of
from experiments.simulation.roboarm.sequences import (
    PARTS,
    RoboArmConfig,
    make_frame,
    make_sequence,
    scene_parts,
)
from prism_jax.data.recordings import DEPTH_SCALE
from prism_jax.envelope.robot import on_triangles
from prism_jax.envelope.voxels import view_of_depth
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import Visibility
from prism_jax.io.atomic import write_bytes

SPACING = 0.02
"""Metres between points on the true surfaces."""

MAX_DRAWS = 60


class Cell(NamedTuple):
    """A frame and what is true of it: world frame, metres, z up.

    Attributes:
      arm: the robot.
      camera: the depth camera, and `depth` its image in metres, 0 without a return.
      partial: what it measured of robot and fixtures, without clutter.
      complete: those surveyed from all around.
      parts: points on the true surfaces of each of `PARTS`, within `SPACING`.
    """

    arm: str
    camera: Camera
    depth: Float64[np.ndarray, "H W"]
    partial: Float32[np.ndarray, "N 3"]
    complete: Float32[np.ndarray, "M 3"]
    parts: dict[str, Float32[np.ndarray, "S 3"]]

    @property
    def view(self) -> Visibility:
        """What the camera knows."""
        return view_of_depth(self.depth, self.depth > 0, self.camera)


def make_cell(split: str, seed: int, index: int) -> bytes:
    """A cell's file: a pure function of the arguments.

    Arms are the split's in turn. A draw of which too little is seen is drawn again.
    """
    arms, config = arms_of(split), RoboArmConfig()
    model = arms[index % len(arms)]
    for attempt in range(MAX_DRAWS):
        rng = own_rng(split, seed, index, 0, attempt)
        try:
            sequence = make_sequence(model, 1, config, rng)
            frame = make_frame(sequence, 0, config, rng)
            break
        except ValueError as error:
            fault = error
    else:
        raise ValueError(f"no cell of {model.name} in {MAX_DRAWS} draws: {fault}")
    assert frame.complete is not None
    arrays = {
        "arm": np.array(model.name),
        "counts": frame.depth,
        "partial": frame.partial,
        "complete": frame.complete,
        **{name: np.asarray(getattr(frame.camera, name)) for name in _CAMERA},
    }
    for name, mesh in scene_parts(sequence, 0).items():
        points = on_triangles(mesh.vertices, mesh.faces, SPACING)
        arrays[f"part_{name}"] = points.astype(np.float32)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


_CAMERA = ("rotation", "translation", "intrinsics")


def read_cell(path: pathlib.Path) -> Cell:
    """A cell that was made before."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    height, width = arrays["counts"].shape
    return Cell(
        arm=str(arrays["arm"]),
        camera=Camera(*(arrays[name] for name in _CAMERA), height, width),
        depth=arrays["counts"] * DEPTH_SCALE,
        partial=arrays["partial"],
        complete=arrays["complete"],
        parts={name: arrays[f"part_{name}"] for name in PARTS},
    )


def cells(
    folder: pathlib.Path, split: str, seed: int, count: int, num_workers: int
) -> Iterator[Cell]:
    """The first so many cells of a split and a seed; what is missing is made first."""
    places = [folder / f"{split}-{seed}" / f"{i:04d}.npz" for i in range(count)]
    places[0].parent.mkdir(parents=True, exist_ok=True)
    missing = [index for index, place in enumerate(places) if not place.exists()]
    if missing:
        make = functools.partial(make_cell, split, seed)
        with multiprocessing.get_context("spawn").Pool(num_workers) as pool:
            made = pool.imap(make, missing)
            told = tqdm.tqdm(made, f"{split} cells", len(missing), disable=None)
            for index, data in zip(missing, told, strict=True):
                write_bytes(places[index], data)
    return map(read_cell, places)
