"""Measures the coverage of envelope margins, and how much space stays free.

    python -m experiments.coverage --weights=small --output=FILE.json

Uses simulated robot cells, each with its own arm pose, fixtures and camera. Margins are
calibrated on some cells and tested on others with the same arms; a second calibration
on other arms shows how well a margin transfers to new arms. Scans are the whole depth
image, or only the cloud of robot and fixtures.
"""

import dataclasses
import functools
import io
import multiprocessing
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from absl import flags
from jaxtyping import Bool, Float, Float32, Float64
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.scoring import print_and_write
from experiments.simulation.roboarm.build import own_rng
from experiments.simulation.roboarm.models import arms_of
from experiments.simulation.roboarm.sequences import (
    PARTS,
    RoboArmConfig,
    make_frame,
    make_sequence,
    scene_parts,
)
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.completer import Completer
from prism_jax.completion.weights import file_sha256
from prism_jax.data.recordings import DEPTH_SCALE
from prism_jax.envelope.calibration import (
    cell_score,
    cells_needed,
    conformal_margin,
    coverage_interval,
)
from prism_jax.envelope.carving import carve, view_of_cloud, view_of_depth
from prism_jax.envelope.distance import Surfaces
from prism_jax.envelope.robot import of_robot, on_triangles
from prism_jax.envelope.surfaces import FLOOR, Method, see, thinned
from prism_jax.envelope.voxels import (
    FREE,
    Grid,
    label,
)
from prism_jax.evaluation.tables import table_lines
from prism_jax.geometry.camera import Camera
from prism_jax.io.atomic import write_bytes
from prism_jax.io.depth import points_from_depth
from prism_jax.io.errors import InputError
from prism_jax.io.files import default_cache_dir
from prism_jax.training.run import commit

FLAGS = flags.FLAGS
ALPHAS = (0.1, 0.05)
WORKSPACE = np.array([(-1.5, -1.5, 0.0), (1.5, 1.5, 3.0)])
"""Metres: the 3 m cell."""

SPACING = 0.02
"""Metres between points on the true surfaces."""

SAMPLE = 20_000
"""Voxels of a cell that volumes are estimated from, the same ones in every cell: 2 % of
a tenth of the cell is a standard error, and volumes are means over cells."""

SETS = {
    "calibration": ("test", 1),
    "test": ("test", 2),
    "other_arms": ("validation", 1),
}
"""Split, whose arms these are, and seed."""

AROUND = {
    "measured": "what was measured",
    "completed": "measured and predicted",
    "scaled": "the same, in scales of expected errors",
}
"""What a margin is laid around. A known robot is part of each."""


class Cell(NamedTuple):
    """A frame and what is true of it: world frame, metres, z up.

    Attributes:
      camera: the depth camera, and `depth` its image in metres, 0 without a return.
      partial: what it measured of robot and fixtures, without clutter.
      complete: those surveyed from all around.
      parts: points on the true surfaces of each of `PARTS`, within `SPACING`.
    """

    camera: Camera
    depth: Float64[np.ndarray, "H W"]
    partial: Float32[np.ndarray, "N 3"]
    complete: Float32[np.ndarray, "M 3"]
    parts: dict[str, Float32[np.ndarray, "S 3"]]


class Scored(NamedTuple):
    """One scan of a cell, with one knowledge of its robot.

    Attributes:
      scores: the margin that each of `AROUND` needs; of weights that expect no errors,
        none is scaled.
      away: how far `SAMPLE` voxels' middles are from each, in metres (or in scales).
        This and the rest only of tested cells.
      not_free: which of these voxels are not free.
      freed: of points of `Cell.complete`, whether their voxel is free.
      occupied: whether the voxels that hold a true surface are free.
    """

    scores: dict[str, float]
    away: dict[str, Float[np.ndarray, " V"]]
    not_free: Bool[np.ndarray, " V"]
    freed: Bool[np.ndarray, " M"]
    occupied: Bool[np.ndarray, " O"]


_CAMERA = ("rotation", "translation", "intrinsics")


def make_cell(split: str, seed: int, index: int) -> bytes:
    """A cell's file, a pure function of the arguments. Arms are the split's in turn; a
    draw of which too little is seen is drawn again."""
    arms, config = arms_of(split), RoboArmConfig()
    model = arms[index % len(arms)]
    for attempt in range(60):
        rng = own_rng(split, seed, index, 0, attempt)
        try:
            sequence = make_sequence(model, 1, config, rng)
            frame = make_frame(sequence, 0, config, rng)
            break
        except ValueError as error:
            fault = error
    else:
        raise ValueError(f"no cell of {model.name} in 60 draws: {fault}")
    arrays: dict[str, Any] = {"counts": frame.depth, "partial": frame.partial}
    arrays["complete"] = np.asarray(frame.complete)
    arrays |= {name: np.asarray(getattr(frame.camera, name)) for name in _CAMERA}
    for name, mesh in scene_parts(sequence, 0).items():
        points = on_triangles(mesh.vertices, mesh.faces, SPACING)
        arrays[f"part_{name}"] = points.astype(np.float32)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def read_cell(path: pathlib.Path) -> Cell:
    """A cell that was made before."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return Cell(
        camera=Camera(*(arrays[name] for name in _CAMERA), *arrays["counts"].shape),
        depth=arrays["counts"] * DEPTH_SCALE,
        partial=arrays["partial"],
        complete=arrays["complete"],
        parts={name: arrays[f"part_{name}"] for name in PARTS},
    )


def cells(folder: pathlib.Path, name: str, count: int, workers: int) -> Iterator[Cell]:
    """The first so many cells of one of `SETS`; what is missing is made and kept."""
    split, seed = SETS[name]
    places = [folder / f"{split}-{seed}" / f"{i:04d}.npz" for i in range(count)]
    places[0].parent.mkdir(parents=True, exist_ok=True)
    missing = [index for index, place in enumerate(places) if not place.exists()]
    if missing:
        make = functools.partial(make_cell, split, seed)
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            made = tqdm(pool.imap(make, missing), f"{name}, made", len(missing))
            for index, data in zip(missing, made, strict=True):
                write_bytes(places[index], data)
    return map(read_cell, tqdm(places, name, mininterval=2.0))


def scored(
    completer: Completer, cell: Cell, robot: Any, tested: bool
) -> dict[str, Scored]:
    """A cell's scans, completed without adaptation and measured against its truth; the
    robot is "known" or "unknown"."""
    method = Method(robot=robot, around="objects")
    known = cell.parts["robot"].astype(float) if robot == "known" else None
    cloud = see(completer, cell.partial, cell.camera, method, "z", known)
    image = points_from_depth(cell.depth, cell.depth > 0, cell.camera)
    image = image[~of_robot(image, cloud.robot)]
    together = np.concatenate([cloud.measured, thinned(image)])
    depth = dataclasses.replace(cloud, measured=together)
    truth, grid = cell.complete.astype(float), Grid.over(*WORKSPACE)
    occupied = grid.index_of(np.concatenate([*cell.parts.values()]))
    occupied = np.unique(occupied[occupied >= 0])
    asked = np.random.default_rng(1).choice(np.prod(grid.shape), SAMPLE, replace=False)
    found = {}
    scans = {"depth": (depth, image), "cloud": (cloud, cloud.measured)}
    for name, (seen, measured) in scans.items():
        around = {
            "measured": Surfaces({"measured": seen.measured, "robot": seen.robot})
        }
        around["completed"] = seen.surfaces()
        if seen.sigma is not None:
            around["scaled"] = seen.surfaces(FLOOR)
        scores = {kind: cell_score(truth, one) for kind, one in around.items()}
        if not tested:
            nothing = np.zeros(0, bool)
            found[name] = Scored(scores, {}, nothing, nothing, nothing)
            continue
        if name == "depth":
            view = view_of_depth(cell.depth, cell.depth > 0, cell.camera)
        else:
            view = view_of_cloud(cell.partial, np.asarray(cell.camera.position))
        state = label(grid, carve(grid, view), measured, seen.predicted, seen.robot)
        free = state.ravel() == FREE
        middles, index = grid.middles(asked), grid.index_of(truth)
        found[name] = Scored(
            scores,
            {kind: one.needed(middles) for kind, one in around.items()},
            ~free[asked],
            (index >= 0) & free[index],
            free[occupied],
        )
    return found


def coverage(
    found: Mapping[str, Sequence[Scored]], alphas: Sequence[float]
) -> dict[str, Any]:
    """What one scan and one knowledge of the robot give, of the cells of each set."""
    tested, grid = found["test"], Grid.over(*WORKSPACE)
    whole = np.prod(grid.upper - grid.lower)
    without = sum(not one.freed.any() for one in tested)
    rows = []
    for calibrated_on in ("calibration", "other_arms"):
        for kind in tested[0].scores:
            for alpha in alphas:
                scores = [one.scores[kind] for one in found[calibrated_on]]
                margin = conformal_margin(scores, alpha)
                covered = sum(one.scores[kind] <= margin for one in tested)
                # A voxel counts if the margin reaches its corner.
                reach = margin + (0.0 if kind == "scaled" else grid.half_diagonal)
                taken = [one.not_free & (one.away[kind] <= reach) for one in tested]
                shares = [
                    (one.away[kind][one.not_free] <= reach).mean() for one in tested
                ]
                row = {"calibrated_on": calibrated_on, "around": kind, "alpha": alpha}
                row |= {"q": margin, "covered": covered, "tested": len(tested)}
                row["interval"] = coverage_interval(covered, len(tested))
                row["volume"] = float(np.mean(taken) * whole)
                row["share_of_not_free"] = float(np.mean(shares))
                rows.append(row)
    return {
        "rows": rows,
        "free_volume": float(whole * (1 - np.mean([s.not_free for s in tested]))),
        "cells_with_none_freed": without,
        "interval": coverage_interval(without, len(tested)),
        "true_points_freed": float(np.mean([one.freed.mean() for one in tested])),
        "occupied_voxels": sum(len(one.occupied) for one in tested),
        "occupied_voxels_freed": int(sum(one.occupied.sum() for one in tested)),
        "scores": {
            name: {kind: [one.scores[kind] for one in some] for kind in some[0].scores}
            for name, some in found.items()
        },
    }


def coverage_markdown(result: Mapping[str, Any]) -> str:
    """A row for each margin, and one for all that is not free."""
    head = ["robot", "scan", "calibrated on", "margin around"]
    head += ["wanted", "q, m", "coverage", "volume, m3"]
    cells, volume = [], np.prod(WORKSPACE[1] - WORKSPACE[0])
    for robot, scans in result["robot"].items():
        for scan, told in scans.items():
            for row in told["rows"]:
                unit = " scales" if row["around"] == "scaled" else ""
                cells.append([robot, scan, row["calibrated_on"], AROUND[row["around"]]])
                cells[-1] += [f"{1 - row['alpha']:.0%}", f"{row['q']:.3f}{unit}"]
                share = row["covered"] / row["tested"]
                cells[-1] += [_share(share, row["interval"]), f"{row['volume']:.2f}"]
            share = told["cells_with_none_freed"] / result["num_tested"]
            cells.append([robot, scan, "-", "all that is not free", "-", "-"])
            not_free = volume - told["free_volume"]
            cells[-1] += [_share(share, told["interval"]), f"{not_free:.2f}"]
    return "\n".join(table_lines(head, cells)) + "\n"


def _share(share: float, interval: Sequence[float]) -> str:
    low, high = interval
    return f"{share:.0%} [{low:.0%}, {high:.0%}]"


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_integer("num_cells", 100, "Cells to calibrate on.", 1)
    flags.DEFINE_integer("num_tested", 100, "Cells to test on.", 1)
    flags.DEFINE_string("weights", "small", "Weights, name or file.")
    flags.DEFINE_string("cell_dir", None, "Folder of cells. Default: user cache.")
    flags.DEFINE_integer("num_workers", 2, "Processes that make cells.", 1)
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Calibrates, tests, prints the table and writes the result."""
    prepare_output(FLAGS.output, ".json")
    alphas = [alpha for alpha in ALPHAS if FLAGS.num_cells >= cells_needed(alpha)]
    if not alphas:
        fault, remedy = "too few", f"use {cells_needed(max(ALPHAS))} or more"
        raise InputError("--num_cells", fault, remedy)
    weights, cache = located(FLAGS.weights), default_cache_dir()
    completer = Completer.from_pretrained(weights, cache / "traced")
    folder = pathlib.Path(FLAGS.cell_dir or cache / "envelope-cells")
    result: dict[str, Any] = {
        "commit": commit(),
        "weights": FLAGS.weights,
        "weights_sha256": file_sha256(weights),
        "num_cells": FLAGS.num_cells,
        "num_tested": FLAGS.num_tested,
        "workspace": WORKSPACE.tolist(),
        "robot": {},
    }
    for robot in ("unknown", "known"):
        found = {}
        for name in SETS:
            tested = name == "test"
            count = FLAGS.num_tested if tested else FLAGS.num_cells
            some = cells(folder, name, count, FLAGS.num_workers)
            found[name] = [scored(completer, cell, robot, tested) for cell in some]
        result["robot"][robot] = {
            scan: coverage({n: [c[scan] for c in s] for n, s in found.items()}, alphas)
            for scan in ("depth", "cloud")
        }
    print_and_write(result, coverage_markdown(result))


def run() -> None:
    """The entry point."""
    define_flags()
    launch("coverage", main)


if __name__ == "__main__":
    run()
