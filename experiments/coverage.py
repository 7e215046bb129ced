"""Measures the coverage of envelope margins, and how much space they take.

    python -m experiments.coverage --weights=small --output=FILE.json

Uses simulated robot cells, each with its own arm pose, fixtures and camera. Margins are
calibrated on some cells and tested on others with the same arms; a second calibration
on other arms shows how well a margin transfers to new arms, and whether a margin for
each size of scan, or one that is updated as truth comes in, transfers better. Scans are
the whole depth image, the cloud of robot and fixtures, or that cloud beside the image.
"""

import functools
import io
import multiprocessing
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, get_args

import numpy as np
from absl import flags
from jaxtyping import Bool, Float, Float32
from scipy.stats import binomtest
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.run_folder import commit
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
from prism_jax.data.recordings import DEPTH_SCALE, RecordedFrame
from prism_jax.envelope.calibration import (
    cell_score,
    cells_needed,
    conformal_margin,
)
from prism_jax.envelope.carving import CloudView, DepthView, carve
from prism_jax.envelope.distance import Surfaces
from prism_jax.envelope.recorded import seen_in
from prism_jax.envelope.robot import on_triangles
from prism_jax.envelope.surfaces import Input, Method
from prism_jax.envelope.voxels import Grid
from prism_jax.evaluation.tables import table_lines
from prism_jax.geometry.camera import Camera
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError
from prism_jax.io.files import default_cache_dir

FLAGS = flags.FLAGS
ALPHA = 0.1
RATE = 0.05  # of the update of alpha, after each tested cell
GROUPS = 3  # of scans by their size
WORKSPACE = (-1.5, -1.5, 0.0, 1.5, 1.5, 3.0)
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

AROUND = {"measured": "what was measured", "completed": "measured and predicted"}
"""What a margin is laid around. A known robot is part of each."""


class Cell(NamedTuple):
    """A frame in metres and z up, and points on the true surfaces of each of `PARTS`,
    within `SPACING`."""

    frame: RecordedFrame
    parts: dict[str, Float32[np.ndarray, "S 3"]]


class Scored(NamedTuple):
    """One scan of a cell, with one knowledge of its robot."""

    scores: dict[str, float]  # the margin that each of `AROUND` needs
    size: float  # the diagonal of what is completed, in metres
    # How far `SAMPLE` voxels' middles are from each of `AROUND`. This and the rest only
    # of tested cells.
    away: dict[str, Float[np.ndarray, " V"]]
    not_free: Bool[np.ndarray, " V"]  # which of these voxels are not free
    occupied: Bool[np.ndarray, " O"]  # whether the voxels with a true surface are free


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
    camera = Camera(*(arrays[name] for name in _CAMERA), *arrays["counts"].shape)
    clouds = arrays["partial"], arrays["complete"]
    return Cell(
        RecordedFrame(arrays["counts"], camera, *clouds),
        {name: arrays[f"part_{name}"] for name in PARTS},
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


def _grid() -> Grid:
    return Grid.over(np.array(WORKSPACE[:3]), np.array(WORKSPACE[3:]))


class _Remembered:
    """A completer that gives the last completion again for the same points."""

    def __init__(self, completer: Completer):
        self._completer, self._last = completer, (np.zeros(0), None)

    def complete(self, points: np.ndarray, *given: Any, **asked: Any) -> Any:
        if not np.array_equal(self._last[0], points):
            done = self._completer.complete(points, *given, **asked)
            self._last = points, done
        return self._last[1]


def scored(
    completer: Any, cell: Cell, kind: Input, known: bool, tested: bool
) -> Scored:
    """A cell's scan, completed without adaptation and measured against its truth."""
    method = Method(kind, workspace=WORKSPACE, robot="known" if known else None)
    robot = cell.parts["robot"].astype(float) if known else None
    points, seen, truth = seen_in(cell.frame, completer, method, robot, "cell")
    around = {
        "measured": Surfaces({"measured": seen.measured, "robot": seen.robot}),
        "completed": seen.surfaces(),
    }
    scores = {name: cell_score(truth, one) for name, one in around.items()}
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not tested:
        return Scored(scores, size, {}, np.zeros(0, bool), np.zeros(0, bool))
    frame, grid = cell.frame, _grid()
    view = DepthView(frame.depth * DEPTH_SCALE, frame.camera)
    if kind == "cloud":
        view = CloudView(frame.partial, np.asarray(frame.camera.position))
    free = carve(grid, view).ravel()
    asked = np.random.default_rng(1).choice(np.prod(grid.shape), SAMPLE, replace=False)
    index = grid.index_of(np.concatenate([*cell.parts.values()]))
    occupied = free[np.unique(index[index >= 0])]
    middles = grid.middles(asked)
    # A voxel with a surface in it is not free, whatever the rays say.
    for points in around["completed"].points.values():
        index = grid.index_of(points)
        free[index[index >= 0]] = False
    away = {name: one.distance(middles)[0] for name, one in around.items()}
    return Scored(scores, size, away, ~free[asked], occupied)


def fixed(calibrated: Sequence[Scored], tested: Sequence[Scored], around: str):
    """The margin of each tested cell: one q for all."""
    margin = conformal_margin([one.scores[around] for one in calibrated], ALPHA)
    return [margin] * len(tested)


def by_size(calibrated: Sequence[Scored], tested: Sequence[Scored], around: str):
    """Mondrian: a q for each third of the scans by their size (Vovk et al. 2005)."""
    sizes = np.array([one.size for one in calibrated])
    ends = np.quantile(sizes, np.arange(1, GROUPS) / GROUPS)
    group = np.searchsorted(ends, sizes)
    scores = np.array([one.scores[around] for one in calibrated])
    margins = [
        conformal_margin(scores[group == g].tolist(), ALPHA) for g in range(GROUPS)
    ]
    return [margins[np.searchsorted(ends, one.size)] for one in tested]


def updated(calibrated: Sequence[Scored], tested: Sequence[Scored], around: str):
    """Adaptive: alpha moves after each cell whose truth is known (Gibbs & Candes 2021).
    Where it asks for more than there are scores for, the margin is infinite."""
    scores, margins, alpha = [one.scores[around] for one in calibrated], [], ALPHA
    for one in tested:
        least = 1.0 / (len(scores) + 1)
        margin = np.inf if alpha < least else conformal_margin(scores, min(alpha, 0.99))
        alpha += RATE * (ALPHA - (one.scores[around] > margin))
        margins.append(margin)
    return margins


RULES = {"fixed": fixed, "by_size": by_size, "updated": updated}
"""How the margins of tested cells come from calibrated ones."""


def coverage(found: Mapping[str, Sequence[Scored]]) -> dict[str, Any]:
    """What one scan and one knowledge of the robot give, of the cells of each set."""
    tested, grid = found["test"], _grid()
    whole, rows = np.prod(grid.upper - grid.lower), []
    for calibrated_on in ("calibration", "other_arms"):
        for around in AROUND:
            for name, rule in RULES.items():
                margins = rule(found[calibrated_on], tested, around)
                pairs = list(zip(tested, margins, strict=True))
                covered = sum(one.scores[around] <= q for one, q in pairs)
                # A voxel counts if the margin reaches its corner.
                taken = [
                    one.not_free & (one.away[around] <= q + grid.half_diagonal)
                    for one, q in pairs
                ]
                row: dict[str, Any] = {"calibrated_on": calibrated_on}
                row |= {"around": around, "rule": name}
                finite = [q for q in margins if np.isfinite(q)]
                row |= {"q": float(np.mean(finite)), "infinite": len(tested)}
                row["infinite"] -= len(finite)
                row |= {"covered": covered, "tested": len(tested)}
                # After Clopper & Pearson (1934): exact, and so never too narrow.
                exact = binomtest(covered, len(tested)).proportion_ci(0.95, "exact")
                row["interval"] = float(exact.low), float(exact.high)
                row["volume"] = float(np.mean(taken) * whole)
                rows.append(row)
    return {
        "rows": rows,
        "free_volume": float(whole * (1 - np.mean([s.not_free for s in tested]))),
        "occupied_voxels": sum(len(one.occupied) for one in tested),
        "occupied_voxels_freed": int(sum(one.occupied.sum() for one in tested)),
        "scores": {
            name: {kind: [one.scores[kind] for one in some] for kind in AROUND}
            for name, some in found.items()
        },
    }


def coverage_markdown(result: Mapping[str, Any]) -> str:
    """A row for each robot, scan, margin and rule, with both calibrations."""
    head = ["robot", "scan", "margin around", "rule", "q, m", "coverage", "volume, m3"]
    cells = []
    for robot, scans in result["robot"].items():
        for scan, told in scans.items():
            half = len(told["rows"]) // 2
            pairs = zip(told["rows"][:half], told["rows"][half:], strict=True)
            for own, other in pairs:
                row = [robot, scan, AROUND[own["around"]], own["rule"]]
                cells.append([*row, f"{own['q']:.3f}", _share(own)])
                cells[-1] += [f"{own['volume']:.2f}", _share(other)]
    return "\n".join(table_lines([*head, "from other arms"], cells)) + "\n"


def _share(row: Mapping[str, Any]) -> str:
    low, high = row["interval"]
    return f"{row['covered'] / row['tested']:.0%} [{low:.0%}, {high:.0%}]"


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
    needed = GROUPS * cells_needed(ALPHA)
    if FLAGS.num_cells < needed:
        raise InputError("--num_cells", "too few", f"use {needed} or more")
    weights, cache = located(FLAGS.weights), default_cache_dir()
    once = _Remembered(Completer.from_pretrained(weights, cache / "compiled"))
    folder = pathlib.Path(FLAGS.cell_dir or cache / "envelope-cells")
    result: dict[str, Any] = {
        "commit": commit(),
        "weights": FLAGS.weights,
        "weights_sha256": file_sha256(weights),
        "num_cells": FLAGS.num_cells,
        "num_tested": FLAGS.num_tested,
        "alpha": ALPHA,
        "workspace": WORKSPACE,
        "robot": {"unknown": {}, "known": {}},
    }
    found: dict[tuple[str, Input], dict[str, list[Scored]]] = {}
    for name in SETS:
        tested = name == "test"
        count = FLAGS.num_tested if tested else FLAGS.num_cells
        for cell in cells(folder, name, count, FLAGS.num_workers):
            for robot in result["robot"]:
                for kind in get_args(Input):
                    one = scored(once, cell, kind, robot == "known", tested)
                    found.setdefault((robot, kind), {}).setdefault(name, []).append(one)
    for (robot, kind), sets in found.items():
        result["robot"][robot][kind] = coverage(sets)
    print_and_write(result, coverage_markdown(result))


def run() -> None:
    """The entry point."""
    define_flags()
    launch("coverage", main)


if __name__ == "__main__":
    run()
