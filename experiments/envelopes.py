"""What completion is worth to an envelope, and whether its margin holds what it says.

    python -m experiments.envelopes --output=docs/tables/envelopes.json

On simulated robot cells, each with its own arm's pose, fixtures and camera: margins are
calibrated on some and tested on as many others. What the user of a calibration gets is
the first table, cells of the same arms; what a calibration is worth on arms that it
never saw is in the second. Choices (--choices) are made on the validation split alone.
"""

import dataclasses
import pathlib
import time
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import tqdm
from absl import flags
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, Delaunay, KDTree

from experiments.envelope_cells import SPACING, Cell, cells
from experiments.envelope_tables import METHODS, choices_markdown, markdown
from experiments.output import prepare_output
from experiments.scoring import print_and_write
from prism_jax import io
from prism_jax.cli.launch import launch
from prism_jax.completion import Completer
from prism_jax.envelope.calibration import (
    cell_score,
    cells_needed,
    conformal_margin,
    coverage_interval,
)
from prism_jax.envelope.distance import Envelope, Surfaces
from prism_jax.envelope.robot import of_robot, on_triangles
from prism_jax.envelope.surfaces import FLOOR, Method, see, thinned
from prism_jax.envelope.voxels import FREE, Carving, Grid, carve, label
from prism_jax.geometry.visibility import UNKNOWN, look_up
from prism_jax.io.depth import points_from_depth
from prism_jax.io.errors import InputError
from prism_jax.training.run import commit
from prism_jax.weights import file_sha256

FLAGS = flags.FLAGS
ALPHAS = (0.1, 0.05)
WORKSPACE = np.array([(-1.5, -1.5, 0.0), (1.5, 1.5, 3.0)])
"""Metres: the 3 m cell."""

MARGINS, SHARES = (0.0, 0.02, 0.04, 0.08, 0.12), (0.0, 0.5, 0.9)
"""Carving margins in metres and shares that are compared."""

QUERY = 1000
"""Points of a query whose time is taken."""

SAMPLE = 20_000
"""Voxels of a cell that volumes are told from, the same ones in every cell: 2 % of a
tenth of the cell is a standard error, and volumes are means over cells."""

BEYOND = 1.5
"""Metres: no margin is wider."""

SETS = {
    "calibration": ("test", 1),
    "test": ("test", 2),
    "other_arms": ("validation", 1),
}
"""Split, whose arms these are, and seed; `other_arms` is for the second table."""


class Scored(NamedTuple):
    """A cell with one knowledge of its robot.

    Attributes:
      scores: margin that each of `METHODS` needs; NaN for what there is not.
      away: how far `SAMPLE` voxels' middles are from each method's surfaces, in metres
        (of "scaled" in scales), infinite beyond `BEYOND`; only of tested cells.
      not_free: which of them are not free.
      freed: of points of `Cell.complete`, whether their voxel is free.
      counts: of truly occupied voxels: all, those called free, and both of robot and
        fixtures alone, and those that naive carving frees.
      seconds: of a query, and of what makes an envelope ready for one.
    """

    scores: dict[str, float]
    away: dict[str, Float[np.ndarray, " V"]]
    not_free: Bool[np.ndarray, " V"]
    freed: Bool[np.ndarray, " M"]
    counts: dict[str, int]
    seconds: dict[str, float]


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_integer("num_cells", 100, "To calibrate on, and as many to test.", 1)
    flags.DEFINE_string("weights", "small", "Released weights, name or file.")
    flags.DEFINE_bool("choices", False, "Compare settings on validation instead.")
    flags.DEFINE_string("cell_dir", None, "Where cells are kept; the user's cache.")
    flags.DEFINE_integer("num_workers", 2, "Processes that make cells.", 1)
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Measures, writes and prints the tables."""
    prepare_output(FLAGS.output, ".json")
    alphas = [alpha for alpha in ALPHAS if FLAGS.num_cells >= cells_needed(alpha)]
    if not alphas:
        fault, remedy = "are too few", f"take {cells_needed(max(ALPHAS))} or more"
        raise InputError("--num_cells", fault, remedy)
    completer = Completer.from_pretrained(FLAGS.weights, _cache() / "traced")
    if FLAGS.choices:
        result = choices(completer, list(_cells("other_arms")))
        print_and_write(result, choices_markdown(result))
        return
    result: dict[str, Any] = {
        "commit": commit(),
        "weights": FLAGS.weights,
        "weights_sha256": file_sha256(FLAGS.weights),
        "num_cells": FLAGS.num_cells,
        "carving": Carving()._asdict(),
        "workspace": WORKSPACE.tolist(),
        "alphas": alphas,
        "robot": {},
    }
    for robot in ("unknown", "known"):
        found = {
            name: [
                scored(completer, cell, robot, tested=name == "test")
                for cell in tqdm.tqdm(
                    _cells(name),
                    f"{name}, robot {robot}",
                    FLAGS.num_cells,
                    disable=None,
                )
            ]
            for name in SETS
        }
        result["robot"][robot] = tables(found, alphas)
    print_and_write(result, markdown(result))


def scored(
    completer: Completer, cell: Cell, robot: str, tested: bool, completed: str = "rest"
) -> Scored:
    """A cell completed without adaptation, and measured against its truth."""
    method = Method(robot=robot, around="objects", completed=completed)  # type: ignore
    known = cell.parts["robot"].astype(float) if robot == "known" else None
    objects = see(completer, cell.partial, cell.camera, method, "z", known)
    measured = points_from_depth(cell.depth, cell.depth > 0, cell.camera)
    measured = measured[~of_robot(measured, objects.robot)]
    together = np.concatenate([objects.measured, thinned(measured)])
    seen = dataclasses.replace(objects, measured=together)
    surfaces = {
        "measured": Surfaces({"measured": seen.measured, "robot": seen.robot}),
        "completed": seen.surfaces(),
        "objects": Surfaces({"measured": objects.measured, "robot": seen.robot}),
        "objects_completed": objects.surfaces(),
    }
    if seen.sigma is not None:
        surfaces["scaled"] = seen.surfaces(FLOOR)
    truth = cell.complete.astype(float)
    scores = dict.fromkeys(METHODS, np.nan)
    scores |= {name: cell_score(truth, one) for name, one in surfaces.items()}
    hull = Hull(np.concatenate([objects.measured, objects.robot]))
    scores["hull"] = float(hull.distance(truth).max())
    if not tested:
        nothing = np.zeros(0, bool)
        return Scored(scores, {}, nothing, nothing, {}, {})

    start = time.perf_counter()
    grid, view = Grid.over(*WORKSPACE), cell.view
    free = carve(grid, view)
    state = label(grid, free, measured, seen.predicted, seen.robot)
    envelope = Envelope(grid, state, surfaces["completed"], 0.3)
    points = np.random.default_rng(0).uniform(*WORKSPACE, (QUERY, 3))
    envelope.query(points[:1])
    ready = time.perf_counter()
    envelope.query(points)
    seconds = {"query": time.perf_counter() - ready, "ready": ready - start}

    asked = np.random.default_rng(1).choice(state.size, SAMPLE, replace=False)
    middles = grid.middles(asked)
    away = {name: one.needed(middles) for name, one in surfaces.items()}
    away["hull"] = hull.distance(middles)
    freed = state.ravel() == FREE
    index = grid.index_of(truth)
    counts = {}
    naive = _naive(grid, view)
    kinds = {"all": tuple(cell.parts), "objects": ("robot", "fixture")}
    for name, parts in kinds.items():
        own = grid.index_of(np.concatenate([cell.parts[part] for part in parts]))
        own = np.unique(own[own >= 0])
        counts[name] = len(own)
        counts[f"{name}_freed"] = int(freed[own].sum())
        counts[f"{name}_freed_naively"] = int(naive[own].sum())
    lost = (index >= 0) & freed[index]
    return Scored(scores, away, ~freed[asked], lost, counts, seconds)


class Hull:
    """A convex hull and the distance from it, too large by `SPACING` at most."""

    def __init__(self, points: Float[np.ndarray, "N 3"]):
        hull = ConvexHull(points)
        self._inside = Delaunay(points[hull.vertices])
        self._surface = KDTree(on_triangles(points, hull.simplices, SPACING))

    def distance(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """Zero inside; infinite beyond `BEYOND`."""
        away = self._surface.query(points, distance_upper_bound=BEYOND)[0]
        return np.where(self._inside.find_simplex(points) >= 0, 0.0, away)


def tables(
    found: Mapping[str, list[Scored]], alphas: Iterable[float]
) -> dict[str, Any]:
    """All that is told of one knowledge of the robot."""
    tested = found["test"]
    counts = {
        name: sum(one.counts[name] for one in tested) for name in tested[0].counts
    }
    grid = Grid.over(*WORKSPACE)
    unseen = [_volume(grid, one.not_free) for one in tested]
    times = np.array([[one.seconds[k] for k in ("query", "ready")] for one in tested])
    told: dict[str, Any] = {
        "cells": {name: len(some) for name, some in found.items()},
        "scores": {
            name: {m: [one.scores[m] for one in some] for m in METHODS}
            for name, some in found.items()
        },
        "occupied": counts,
        "cells_with_none_freed": int(sum(not one.freed.any() for one in tested)),
        "true_points_freed": float(np.mean([one.freed.mean() for one in tested])),
        "unseen_volume": float(np.mean(unseen)),
        "query_ms": {
            "points": QUERY,
            "median": 1e3 * float(np.median(times[:, 0])),
            "largest": 1e3 * float(times[:, 0].max()),
            "ready": 1e3 * float(np.median(times[:, 1])),
        },
        "rows": [],
    }
    for calibrated in ("calibration", "other_arms"):
        for method in METHODS:
            for alpha in alphas:
                row = _row(found[calibrated], tested, method, alpha, grid)
                if row is not None:
                    told["rows"].append({"calibrated_on": calibrated, **row})
    return told


def _row(
    calibrated: list[Scored],
    tested: list[Scored],
    method: str,
    alpha: float,
    grid: Grid,
) -> dict[str, Any] | None:
    scores = [one.scores[method] for one in calibrated]
    if np.isnan(scores).any():
        return None
    margin = conformal_margin(scores, alpha)
    covered = sum(one.scores[method] <= margin for one in tested)
    low, high = coverage_interval(covered, len(tested))
    # A voxel counts if the margin reaches its corner.
    slack = 0.0 if method == "scaled" else grid.half_diagonal
    volumes, shares = [], []
    for one in tested:
        taken = one.not_free & (one.away[method] <= margin + slack)
        volumes.append(_volume(grid, taken))
        shares.append(taken.sum() / max(one.not_free.sum(), 1))
    return {
        "method": method,
        "alpha": alpha,
        "q": margin,
        "covered": covered,
        "tested": len(tested),
        "interval": [low, high],
        "volume": float(np.mean(volumes)),
        "share_of_unseen": float(np.mean(shares)),
    }


def choices(completer: Completer, validation: list[Cell]) -> dict[str, Any]:
    """What carving frees by its settings, and which points are best completed."""
    grid = Grid.over(*WORKSPACE)
    rows = []
    for margin in MARGINS:
        for share in SHARES:
            sums = np.zeros(5)
            for cell in validation:
                free = carve(grid, cell.view, Carving(margin, share)).ravel()
                own = grid.index_of(np.concatenate([*cell.parts.values()]))
                own = np.unique(own[own >= 0])
                measured = points_from_depth(cell.depth, cell.depth > 0, cell.camera)
                index = grid.index_of(measured)
                free_then = free.copy()
                free_then[index[index >= 0]] = False
                sums += (
                    len(own),
                    free[own].sum(),
                    free_then[own].sum(),
                    free_then.mean(),
                    1,
                )
            rows.append(
                {
                    "margin": margin,
                    "share": share,
                    "occupied_freed": sums[1] / sums[0],
                    "occupied_freed_without_measured": sums[2] / sums[0],
                    "free_share": sums[3] / sums[4],
                }
            )
    naive = np.zeros(2)
    for cell in validation:
        own = grid.index_of(np.concatenate([*cell.parts.values()]))
        own = np.unique(own[own >= 0])
        naive += len(own), _naive(grid, cell.view)[own].sum()
    scores = {}
    for completed in ("all", "rest"):
        some = [scored(completer, c, "known", False, completed) for c in validation]
        scores[completed] = [one.scores["completed"] for one in some]
        scores["nothing"] = [one.scores["measured"] for one in some]
    return {
        "commit": commit(),
        "weights": FLAGS.weights,
        "cells": len(validation),
        "naive_freed": naive[1] / naive[0],
        "carving": rows,
        "robot_known_scores": scores,
    }


def _volume(grid: Grid, sampled: Bool[np.ndarray, " V"]) -> float:
    """Cubic metres that marked voxels of the sample stand for."""
    return float(sampled.mean() * np.prod(grid.upper - grid.lower))


def _naive(grid: Grid, view: Any) -> Bool[np.ndarray, " V"]:
    """Carving by the one pixel that a voxel's middle falls on."""
    state, behind = look_up(view, grid.centers())
    return (state != UNKNOWN) & (behind < 0)


def _cells(name: str) -> Iterable[Cell]:
    folder = _cache() / "envelope-cells"
    if FLAGS.cell_dir is not None:
        folder = pathlib.Path(FLAGS.cell_dir)
    return cells(folder, *SETS[name], FLAGS.num_cells, FLAGS.num_workers)


def _cache() -> pathlib.Path:
    return io.default_cache_dir()


def run() -> None:
    """The entry point."""
    define_flags()
    launch("envelopes", main)


if __name__ == "__main__":
    run()
