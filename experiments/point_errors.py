"""Fits what gives every predicted point its sigma, and measures it on other objects.

    python -m experiments.point_errors --weights=small --output=FILE.json

Validation views of shapes, of kinds that no training saw, of modelled objects and of
robot cells are shifted (`experiments.shifts.any_shift`) and completed as a user's scan
is, not adapted. The trees of `prism_jax.point_errors.PointErrors` are fitted on half of
the objects; the tables are of the others, of the points that a user gets.
`experiments.release --point_errors=FILE.json` ships them with weights.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from absl import flags
from jaxtyping import Float
from scipy.spatial import KDTree
from tqdm import tqdm

from experiments.boosting import (
    FOLDS,
    boosted,
    complete_trees,
    cross_predicted,
    numbered,
    rank_correlation,
)
from experiments.output import prepare_output
from experiments.robustness import completed
from experiments.scoring import print_and_write, require_looks
from experiments.shifts import any_shift, validation_views
from experiments.simulation.build_dataset import build_if_missing
from experiments.weights import located
from prism_jax import metrics
from prism_jax.cli.launch import launch
from prism_jax.completion import Completer
from prism_jax.data.datasets import digest_of
from prism_jax.evaluation.tables import short
from prism_jax.point_errors import CLUES, PointErrors, spread
from prism_jax.training.run import commit
from prism_jax.weights import file_sha256, load_pretrained

FLAGS = flags.FLAGS

SETS = {
    "shapes": ("shapes", "validation"),
    "novel": ("shapes", "novel"),
    "objects": ("objects", "validation"),
    "roboarm": ("roboarm", "validation"),
}
"""By the names that tables give them."""

DEPTH = 4
TREES = {
    "n_estimators": 120,
    "max_depth": DEPTH,
    "learning_rate": 0.08,
    "min_samples_leaf": 40,
    "max_features": 8,
}

LEAST = 1e-4
"""Half sides of the workspace: an error of less is taken for as much, before its
logarithm is taken."""

PATCH = 9
"""Points of the truth, the nearest one included, that a plane is laid through."""

FLAT = 0.15
"""Of a patch: how far its points lie off the plane, in how far they reach along it."""

BEST = 6
"""How many clues the table names, those that alone order points best."""


class Sample(NamedTuple):
    """Points of one completed view: of which set, object and shift.

    Attributes:
      unit: half a side of its workspace, in half the longest side of the truth.
      kept: the network's points that were added, in the unit workspace.
      clues: theirs.
      errors: their true distances from the surface, there.
      added: some of all the points that a user gets beside the measured ones.
      added_errors: theirs.
    """

    data: str
    group: int
    shift: str
    unit: float
    kept: Float[np.ndarray, "P 3"]
    clues: Float[np.ndarray, "P C"]
    errors: Float[np.ndarray, " P"]
    added: Float[np.ndarray, "Q 3"]
    added_errors: Float[np.ndarray, " Q"]


class Listener(PointErrors):
    """Foretells nothing, and keeps the clues that it was asked about last."""

    asked: Float[np.ndarray, "P C"]

    def sigma(self, clues: Float[np.ndarray, "P C"]) -> Float[np.ndarray, " P"]:
        """Ones."""
        self.asked = clues
        return np.ones(len(clues))


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "A name, or a file.")
    flags.DEFINE_integer("limit", 120, "Views of each set, evenly spaced.", 8)
    flags.DEFINE_integer("points", 100, "Points of each view.", lower_bound=10)
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Completes, fits, measures, writes and prints the tables."""
    prepare_output(FLAGS.output, ".json")
    weights = located(FLAGS.weights)
    listener = Listener(**_trees(None), bounds=np.array([-20.0, 20.0]))
    config, variables = load_pretrained(weights)
    require_looks(FLAGS.weights, config)
    completer = Completer(config, variables, point_errors=listener)
    samples = list(completed_views(completer, listener))
    result = {
        "commit": commit(),
        "weights": FLAGS.weights,
        "weights_sha256": file_sha256(weights),
        "digests": {name: digest_of(*place) for name, place in SETS.items()},
        **fitted_and_measured(samples, FLAGS.points),
    }
    print_and_write(result, point_errors_markdown(result))


def completed_views(completer: Completer, listener: Listener) -> Iterator[Sample]:
    """The samples of all sets."""
    for name, (dataset, split) in SETS.items():
        build_if_missing(dataset, split, None)
        views = validation_views(dataset, FLAGS.limit, split)
        group = numbered(1 + max(view.group for view in views))
        for number, view in enumerate(tqdm(views, desc=name, mininterval=2.0)):
            rng = np.random.default_rng([number, len(name)])
            shift, shifted = any_shift(view, rng)
            done = completed(completer, shifted, adapt=False)
            unit = np.asarray(done.workspace.to_unit(done.points[~done.observed]))
            truth = np.asarray(done.workspace.to_unit(shifted.complete))
            # The network's own come first.
            kept = unit[: len(listener.asked)]
            added = _some(unit, FLAGS.points, rng)
            yield Sample(
                name,
                int(group[view.group]),
                shift,
                float(done.workspace.half_extent) / (0.5 * view.size),
                kept,
                listener.asked,
                from_surface(kept, truth),
                added,
                from_surface(added, truth),
            )


def from_surface(
    points: Float[np.ndarray, "P 3"], truth: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, " P"]:
    """Distances from the surface that the truth is a sample of.

    The nearest point of the sample is about half its spacing away even from the surface
    itself. So where that point's neighbourhood is flat, and reaches to where the plane
    through it is nearest, it is the distance from this plane; elsewhere, at edges, rims
    and thin rods, from the point.
    """
    tree = KDTree(truth)
    apart, row = tree.query(points)
    reach, patch = tree.query(truth[row], k=range(1, min(PATCH, len(truth)) + 1))
    offsets = truth[patch] - truth[patch].mean(axis=1, keepdims=True)
    squares = np.einsum("nki,nkj->nij", offsets, offsets)
    values, vectors = np.linalg.eigh(squares)
    to_plane = points - truth[patch].mean(axis=1)
    across = np.abs(np.einsum("ni,ni->n", to_plane, vectors[:, :, 0]))
    along = np.sqrt(np.maximum(apart**2 - across**2, 0.0))
    flat = values[:, 0] <= FLAT**2 * values[:, 1]
    near = flat & (along <= np.median(reach, axis=1)) & (across <= apart)
    return np.where(near, across, apart)


def fitted_and_measured(samples: Sequence[Sample], count: int) -> dict[str, Any]:
    """The fit on objects of even numbers, and how far it is right about the others."""
    samples = [sample for sample in samples if len(sample.kept)]
    kept = [sample for sample in samples if sample.group % 2 == 0]
    rest = [sample for sample in samples if sample.group % 2 == 1]
    found, lift = fitted(kept, count)
    # As it is read from the weights.
    read = PointErrors.from_dict(found.to_dict())
    apart = {}
    for name in sorted({sample.data for sample in samples}):
        others = [sample for sample in kept if sample.data != name]
        own = [sample for sample in rest if sample.data == name]
        if others and own:
            apart[name] = rightness(fitted(others, count, lift)[0], own)
    return {
        "views": {"fitted": len(kept), "held_out": len(rest)},
        "point_errors": found.to_dict(),
        "sigma": measured(read, rest),
        "left_out": apart,
        "deciles": deciles(read, rest),
        "alone": alone(rest),
    }


def fitted(
    samples: Sequence[Sample], count: int, lift: float | None = None
) -> tuple[PointErrors, float]:
    """Boosted trees on so many points of each view, and what lifts their sum from the
    mean of logarithms to the logarithm of the mean, unless it is given. Every set
    weighs the same."""
    rng = np.random.default_rng(0)
    rows = [_some(np.arange(len(sample.kept)), count, rng) for sample in samples]
    numbers = [len(part) for part in rows]
    clues = np.concatenate([s.clues[r] for s, r in zip(samples, rows, strict=True)])
    errors = np.concatenate([s.errors[r] for s, r in zip(samples, rows, strict=True)])
    data = np.repeat([sample.data for sample in samples], numbers)
    fold = np.repeat([sample.group // 2 % FOLDS for sample in samples], numbers)
    _, inverse, sizes = np.unique(data, return_inverse=True, return_counts=True)
    weights = len(data) / sizes[inverse]
    wanted = np.log(np.maximum(errors, LEAST))
    if lift is None:
        said = np.exp(cross_predicted(clues, wanted, weights, fold, **TREES))
        mean, mean_said = (np.average(x, weights=weights) for x in (errors, said))
        lift = float(np.log(mean / mean_said))
    trees = _trees(boosted(clues, wanted, weights, **TREES), lift)
    bounds = np.array([wanted.min(), wanted.max()])
    return PointErrors(**trees, bounds=bounds), lift


def _trees(model: Any, lift: float = 0.0) -> dict[str, Any]:
    """The fields of a fit, or of one that foretells nothing."""
    if model is None:
        nodes = np.zeros((1, 1))
        return {
            "base": 0.0,
            "looks_at": nodes,
            "thresholds": nodes,
            "leaves": np.zeros((1, 2)),
        }
    looks_at, thresholds, leaves = complete_trees(model, DEPTH)
    return {
        "base": float(model.init_.constant_.item()) + lift,
        "looks_at": looks_at,
        "thresholds": thresholds,
        "leaves": leaves,
    }


def measured(found: PointErrors, samples: Sequence[Sample]) -> dict[str, Any]:
    """How far sigmas are right, over all samples, by set and by shift."""
    parts = {"all": samples}
    for name in dict.fromkeys(sample.data for sample in samples):
        parts[name] = [sample for sample in samples if sample.data == name]
    for shift in sorted({sample.shift for sample in samples}):
        parts[shift] = [sample for sample in samples if sample.shift == shift]
    return {name: rightness(found, part) for name, part in parts.items()}


def rightness(found: PointErrors, samples: Sequence[Sample]) -> dict[str, Any]:
    """Of one part of the samples; lengths are in half the longest side of the truth."""
    pairs = [_told(found, sample) for sample in samples]
    within = [rank_correlation(sigma, error) for sigma, error in pairs]
    sigma, error = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    return {
        "views": len(samples),
        **_coverage(sigma, error),
        "rank_correlation": rank_correlation(sigma, error),
        "within_views": float(np.median([r for r in within if r is not None] or [0])),
    }


def deciles(found: PointErrors, samples: Sequence[Sample]) -> list[dict[str, Any]]:
    """The same of tenths of all points, those of the smallest sigmas first."""
    pairs = [_told(found, sample) for sample in samples]
    sigma, error = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    order = np.argsort(sigma, kind="stable")
    return [_coverage(sigma[r], error[r]) for r in np.array_split(order, 10)]


def alone(samples: Sequence[Sample]) -> dict[str, float | None]:
    """The rank correlation of each clue alone with the true error."""
    clues = np.concatenate([sample.clues for sample in samples])
    error = np.concatenate([sample.errors for sample in samples])
    step = -(-len(error) // 50_000)
    return {
        name: rank_correlation(clues[::step, number], error[::step])
        for number, name in enumerate(CLUES)
    }


def _told(found: PointErrors, sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Expected and true errors of the points that a user gets of one view."""
    sigma = spread(sample.added, sample.kept, found.sigma(sample.clues))
    return sample.unit * sigma, sample.unit * sample.added_errors


def _coverage(sigma: np.ndarray, error: np.ndarray) -> dict[str, float]:
    return {
        "points": len(error),
        "expected": float(sigma.mean()),
        "error": float(error.mean()),
        "below_one": float((error < sigma).mean()),
        "below_two": float((error < 2 * sigma).mean()),
        "holds_95": float(np.quantile(error / sigma, 0.95)),
    }


def _some(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """So many of the rows, or all."""
    if len(rows) <= count:
        return rows
    return rows[np.sort(rng.choice(len(rows), count, replace=False))]


COLUMNS = (
    "| points | expected x1e3 | error x1e3 | below sigma | below 2 sigma | "
    "95 % below, in sigmas |"
)


def point_errors_markdown(result: Mapping[str, Any]) -> str:
    """Rows for all points, each set, each shift, each set left out, and each tenth."""
    views = result["views"]
    best = sorted(
        ((name, r) for name, r in result["alone"].items() if r is not None),
        key=lambda pair: -abs(pair[1]),
    )
    told = ", ".join(f"{name} {r:.2f}" for name, r in best[:BEST])
    lines = [
        f"`{result['weights']}`, commit {short(result['commit'] or 'unknown')}, fitted "
        f"on {views['fitted']:,} shifted validation views, measured on "
        f"{views['held_out']:,} of other objects. Unit of length: {metrics.UNIT}.\n",
        f"| of {COLUMNS} rank correlation | within a view |",
        "| --- |" + " --- |" * 8,
        *(_row(name, row) for name, row in result["sigma"].items()),
        *(
            _row(f"{name}, fitted without", row)
            for name, row in result["left_out"].items()
        ),
        f"\n| tenth of sigma {COLUMNS}",
        "| --- |" + " --- |" * 6,
        *(_row(f"{n}", row) for n, row in enumerate(result["deciles"], 1)),
        f"\nRank correlation of a single clue with the error: {told}.",
    ]
    return "\n".join(lines) + "\n"


def _row(name: str, row: Mapping[str, Any]) -> str:
    cells = [
        name,
        f"{row['points']:,}",
        f"{1e3 * row['expected']:.4g}",
        f"{1e3 * row['error']:.4g}",
        f"{row['below_one']:.0%}",
        f"{row['below_two']:.0%}",
        f"{row['holds_95']:.3g}",
    ]
    if "rank_correlation" in row:
        found = row["rank_correlation"]
        cells.append("-" if found is None else f"{found:.2f}")
        cells.append(f"{row['within_views']:.2f}")
    return f"| {' | '.join(cells)} |"


def run() -> None:
    """The entry point."""
    define_flags()
    launch("point_errors", main)


if __name__ == "__main__":
    run()
