"""Fits the confidence of completions and the sigma of points, and measures both.

    python -m experiments.calibrate --weights=small --output=FILE.json

Validation views are shifted at random and completed as a user's scan is. What is fitted
is a `Calibration`, which expects the error of a completion, and `PointErrors`, which
expect that of each point. Both are measured on objects that they did not see.
`experiments.release --calibration=FILE.json` ships them with the weights.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from absl import flags
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.stats import spearmanr
from tqdm import tqdm

from experiments import robustness
from experiments.output import prepare_output
from experiments.run_folder import commit
from experiments.scoring import print_and_write, require_looks
from experiments.simulation.build_dataset import build_if_missing
from experiments.splits import digest_of
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.assembly import CompletedScan
from prism_jax.completion.completer import Completer
from prism_jax.completion.weights import file_sha256, load_pretrained
from prism_jax.data.datasets import open_dataset
from prism_jax.data.pipeline import Framing, frame_example
from prism_jax.io.errors import require
from prism_jax.models.backbone import encode_points
from prism_jax.uncertainty.confidence import EVIDENCE, Calibration, Verdict, logarithms
from prism_jax.uncertainty.sigma import PointErrors, spread

FLAGS = flags.FLAGS
Row = Float[np.ndarray, " N"]
Table = Float[np.ndarray, "N C"]
Cloud = Float[np.ndarray, "N 3"]

SETS = {
    "shapes": ("shapes", "validation"),
    "novel": ("shapes", "novel"),
    "objects": ("objects", "validation"),
    "roboarm": ("roboarm", "validation"),
}
"""Data set and split of what sigma is fitted on, by the names that tables give them."""

VERDICT_SETS = ("shapes", "roboarm")
VERDICT_TREES = {"n_estimators": 150, "max_depth": 3, "learning_rate": 0.03}
VERDICT_TREES |= {"min_samples_leaf": 8}
SIGMA_TREES = {"n_estimators": 120, "max_depth": 4, "learning_rate": 0.08}
SIGMA_TREES |= {"min_samples_leaf": 40, "max_features": 8}

FOLDS = 5  # that cross-validation leaves out in turn
SIGMA_VIEWS = 120  # of each set, unless --limit is given
NUM_AXES = 16  # along which the features of training views vary most
LOW_FOR_NOTHING = 0.1  # share of the better half that may be called low
LEAST = 1e-4  # half sides of the workspace: smaller errors count as much
PATCH = 9  # points of the truth, the nearest one included, that a plane is laid through
FLAT = 0.15  # how far such points lie off the plane, in how far they reach along it

NODES, LEAVES = np.zeros((1, 1)), np.zeros((1, 2))
NO_TREES = 0.0, NODES, NODES, LEAVES, np.array([-20.0, 20.0])


class Scan(NamedTuple):
    """A completed view. Objects are numbered at random; the half extent of the
    workspace and the error, CD-L1, are in half the longest side of the truth."""

    data: str
    group: int
    shift: str
    half_extent: float
    evidence: dict[str, float]
    error: float


class Points(NamedTuple):
    """Points of a completed view in the unit workspace: the network's that were added,
    their clues and distances from the true surface, and some of all that were added."""

    scan: Scan
    kept: Cloud
    clues: Table
    errors: Row
    added: Cloud
    added_errors: Row


class Listener(PointErrors):
    """Expects nothing, and keeps the clues that it was last given."""

    asked: Table

    def sigma(self, clues: Table) -> Row:
        """Ones."""
        self.asked = clues
        return np.ones(len(clues))


def training_features(completer: Completer, count: int) -> Table:
    """Global features of views as a training sees them."""
    model, variables = completer.config.model, completer.variables
    build_if_missing("shapes", "train")
    source = open_dataset("shapes", "train")
    framing = Framing(model.backbone.num_points, 1, model.margin, model.heading)

    @jax.jit
    def encode(partial):
        return encode_points(variables, model.backbone, partial).global_feature

    rows = np.linspace(0, len(source) - 1, min(count, len(source))).astype(int)
    features = []
    for row in tqdm(rows, desc="features", mininterval=2.0):
        batch = frame_example(source[int(row)], framing, np.random.default_rng(row))
        features.append(np.asarray(encode(batch.partial)))
    return np.array(features, np.float64)


def unfitted(features: Table) -> Calibration:
    """One that knows what is familiar, and nothing of errors."""
    mean = features.mean(axis=0)
    off = features - mean
    _, scale, axes = np.linalg.svd(off, full_matrices=False)
    axes = axes[:NUM_AXES]
    rest = off - (off @ axes.T) @ axes
    scale = scale[: len(axes)] / np.sqrt(len(features))
    least = 1e-6 * max(float(scale[0]), 1e-6)  # equal features have no spread at all
    axes = axes / np.maximum(scale, least)[:, None]
    beside = max(float(np.sqrt((rest**2).sum(axis=1).mean())), least)
    return Calibration(*NO_TREES, np.zeros(len(EVIDENCE)), 1.0, 1.0, mean, axes, beside)


def completed_views(
    completer: Completer, names: Iterable[str], limit: int | None, draws: int | None
) -> Iterator[tuple[Scan, robustness.View, CompletedScan, np.random.Generator]]:
    """Views of each set, each shifted at random, in as many ways as there are draws (or
    in one of the set's own), and completed; and the random numbers of each."""
    for name in names:
        views = robustness.views_of(*SETS[name], limit)
        group = np.random.default_rng(0).permutation(1 + max(v.group for v in views))
        for number, view in enumerate(tqdm(views, desc=name, mininterval=2.0)):
            for draw in range(draws) if draws else [len(name)]:
                rng = np.random.default_rng([number, draw])
                shift, moved = robustness.any_shift(view, rng)
                # Half of those that may be said to show all that the sensor saw.
                may = shift not in ("crop", "tilt") and moved.eye is not None
                empty = may and rng.random() < 0.5
                background = "empty" if empty else "unknown"
                done = robustness.completed(completer, moved, background=background)
                half_extent = float(done.workspace.half_extent) / (0.5 * view.size)
                assert done.verdict is not None
                error = robustness.scored(moved, done.points).cd_l1
                place = name, int(group[view.group]), shift, half_extent
                yield Scan(*place, done.verdict.evidence, error), moved, done, rng


def completed_points(completer: Completer, limit: int, count: int) -> list[Points]:
    """What sigma is fitted on, with so many of the points that a user gets."""
    completer.point_errors = listener = Listener(*NO_TREES)
    found = []
    for scan, view, done, rng in completed_views(completer, SETS, limit, None):
        points = np.asarray(done.workspace.to_unit(done.points[~done.observed]))
        truth = np.asarray(done.workspace.to_unit(view.complete))
        kept = points[: len(listener.asked)]  # the network's own come first
        own = kept, listener.asked, from_surface(kept, truth)
        added = _some(points, count, rng)
        found.append(Points(scan, *own, added, from_surface(added, truth)))
    return found


def from_surface(points: Cloud, truth: Cloud) -> Row:
    """Distances from the surface that the truth is a sample of: from the plane through
    the sample's points nearby, where these are flat and reach to where it is nearest;
    elsewhere, at edges, rims and thin rods, from the nearest point, which is half the
    spacing away even from a point of the surface."""
    tree = KDTree(truth)
    apart, row = tree.query(points)
    reach, patch = tree.query(truth[row], k=range(1, min(PATCH, len(truth)) + 1))  # pyright: ignore
    offsets = truth[patch] - truth[patch].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    to_plane = points - truth[patch].mean(axis=1)
    across = np.abs(np.einsum("ni,ni->n", to_plane, vectors[:, :, 0]))
    along = np.sqrt(np.maximum(apart**2 - across**2, 0.0))
    flat = values[:, 0] <= FLAT**2 * values[:, 1]
    near = flat & (along <= np.median(reach, axis=1)) & (across <= apart)
    return np.where(near, across, apart)


def _some(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """So many of the rows, or all."""
    if len(rows) <= count:
        return rows
    return rows[np.sort(rng.choice(len(rows), count, replace=False))]


def boosted(
    found: Table, wanted: Row, sets: Sequence[str], fold: np.ndarray, settings: Any
) -> tuple[dict[str, Any], Row, Row]:
    """Gradient boosting (Friedman 2001): fields of `Trees`; what trees that saw the
    other folds say of each sample; and the samples' weights, one sum for every set."""
    regressor = require("sklearn.ensemble", "train").GradientBoostingRegressor
    _, inverse, sizes = np.unique(sets, return_inverse=True, return_counts=True)
    weights = len(wanted) / sizes[inverse]

    def fit(rows):
        model = regressor(subsample=0.5, random_state=0, **settings)
        return model.fit(found[rows], wanted[rows], sample_weight=weights[rows])

    said = np.empty(len(wanted))
    for number in np.unique(fold):
        said[fold == number] = fit(fold != number).predict(found[fold == number])
    bounds = np.array([wanted.min(), wanted.max()])
    return {**trees_of(fit(slice(None))), "bounds": bounds}, said, weights


def trees_of(model: Any) -> dict[str, Any]:
    """A scikit-learn model as `Trees` has it: below an early leaf all is that leaf."""
    columns = []
    for (estimator,) in model.estimators_:
        tree, at, inner = estimator.tree_, np.zeros(1, int), np.zeros(0, int)
        for _ in range(model.max_depth):
            inner, is_leaf = np.append(inner, at), tree.children_left[at] < 0
            below = tree.children_left[at], tree.children_right[at]
            at = np.where(is_leaf, at, below).T.ravel()
        is_leaf = tree.children_left[inner] < 0
        nodes = (np.where(is_leaf, 0, n[inner]) for n in (tree.feature, tree.threshold))
        columns.append((*nodes, model.learning_rate * tree.value[at, 0, 0]))
    arrays = [np.array(column, float) for column in zip(*columns, strict=True)]
    fields = dict(zip(("looks_at", "thresholds", "leaves"), arrays, strict=True))
    return {"base": float(model.init_.constant_.item()), **fields}


def fitted_verdicts(blank: Calibration, scans: Sequence[Scan]) -> Calibration:
    """The verdict's trees, and bounds of trust by what is said of objects left out."""
    found = np.array([logarithms(scan.evidence) for scan in scans])
    wanted = np.log([scan.error / scan.half_extent for scan in scans])
    sets = [scan.data for scan in scans]
    fold = np.unique([s.group for s in scans], return_inverse=True)[1] % FOLDS
    fields, said, _ = boosted(found, wanted, sets, fold, VERDICT_TREES)
    # The mean of errors, and not that of their logarithms, is what is expected.
    lift = float(np.log(np.mean(np.exp(wanted)) / np.mean(np.exp(said))))
    said, better = said + lift, wanted <= np.median(wanted)
    # Nine in ten of the worst tenth are low, if that leaves at most `LOW_FOR_NOTHING`
    # of the better half low; else low is half-way between. High is at most half of all.
    least = np.quantile(said[better], 1.0 - LOW_FOR_NOTHING)
    worst = wanted >= np.quantile(wanted, 0.9)
    low = 0.5 * (least + max(least, np.quantile(said[worst], 0.1)))
    fair, low = np.exp([min(np.median(said), low), low])
    fields["base"] += lift
    fields |= {"usual": np.median(found[better], axis=0), "fair": fair, "low": low}
    return Calibration.from_dict(dataclasses.replace(blank, **fields).to_dict())


def judged_unseen(blank: Calibration, scans: Sequence[Scan]) -> list[Verdict]:
    """The verdict on each scan by what was fitted on the objects of other folds."""
    judges = {}
    for fold in {scan.group % FOLDS for scan in scans}:
        others = [scan for scan in scans if scan.group % FOLDS != fold]
        judges[fold] = fitted_verdicts(blank, others).judge
    return [judges[s.group % FOLDS](s.evidence, s.half_extent) for s in scans]


def rightness(scans: Sequence[Scan], verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """How far verdicts are right, over all scans, by set and by shift."""
    rows = {}
    sets, shifts = dict.fromkeys(s.data for s in scans), {s.shift for s in scans}
    for name in ("all", *sets, *sorted(shifts)):
        own = [name in ("all", scan.data, scan.shift) for scan in scans]
        error = np.array([scan.error for scan in scans])[own]
        expected = np.array([verdict.expected_error for verdict in verdicts])[own]
        trust = np.array([verdict.trust for verdict in verdicts])[own]
        low, high = trust == "low", trust == "high"
        rows[name] = {
            "views": len(error),
            "error": float(error.mean()),
            "expected": float(expected.mean()),
            "rank_correlation": rank_correlation(expected, error),
            "worst_tenth_low": float(low[error >= np.quantile(error, 0.9)].mean()),
            "better_half_low": float(low[error <= np.median(error)].mean()),
            "low": float(low.mean()),
            "high": float(high.mean()),
            "error_of_low": float(error[low].mean()) if low.any() else None,
            "error_of_high": float(error[high].mean()) if high.any() else None,
        }
    return rows


def rank_correlation(first: Row, second: Row) -> float | None:
    """Spearman's; None where all of one are equal."""
    if len(first) == 0 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(spearmanr(first, second)[0])  # pyright: ignore


def sigmas(samples: Sequence[Points], count: int) -> dict[str, Any]:
    """The fit on objects of even numbers, from so many points of each view, and how far
    it is right about the others, in half the longest side of the truth."""
    samples = [sample for sample in samples if len(sample.kept)]
    even, odd = ([s for s in samples if s.scan.group % 2 == half] for half in (0, 1))
    rng = np.random.default_rng(0)
    pairs = [(s, _some(np.arange(len(s.kept)), count, rng)) for s in even]
    clues = np.concatenate([sample.clues[rows] for sample, rows in pairs])
    errors = np.concatenate([sample.errors[rows] for sample, rows in pairs])
    scans = [sample.scan for sample, rows in pairs for _ in rows]
    sets, fold = [s.data for s in scans], [s.group // 2 % FOLDS for s in scans]
    wanted = np.log(np.maximum(errors, LEAST))
    fields, said, weights = boosted(clues, wanted, sets, np.array(fold), SIGMA_TREES)
    # From the mean of logarithms to the logarithm of the mean.
    mean, found = (np.average(x, weights=weights) for x in (errors, np.exp(said)))
    fields["base"] += float(np.log(mean / found))
    fitted = PointErrors.from_dict(PointErrors(**fields).to_dict())
    units = np.repeat([s.scan.half_extent for s in odd], [len(s.added) for s in odd])
    said = [spread(s.added, s.kept, fitted.sigma(s.clues)) for s in odd]
    sigma = units * np.concatenate(said)
    error = units * np.concatenate([sample.added_errors for sample in odd])
    right = {
        "expected": float(sigma.mean()),
        "error": float(error.mean()),
        "below_one": float((error < sigma).mean()),
        "below_two": float((error < 2 * sigma).mean()),
        "holds_95": float(np.quantile(error / sigma, 0.95)),
        "rank_correlation": rank_correlation(sigma, error),
    }
    views = {"fitted": len(even), "held_out": len(odd)}
    return {"point_errors": fitted.to_dict(), "sigma": {"all": right}, "views": views}


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "Weights, name or file.")
    flags.DEFINE_integer("limit", None, "Views per data set, evenly spaced.", 4)
    flags.DEFINE_integer("draws", 3, "Shifts per view, for the confidence.", 1)
    flags.DEFINE_integer("training", 1000, "Training views for novelty.")
    flags.DEFINE_integer("points", 100, "Points per view, for sigma.", 10)
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Completes, fits, measures, prints the tables and writes the result."""
    prepare_output(FLAGS.output, ".json")
    weights = located(FLAGS.weights)
    completer = Completer(*load_pretrained(weights))
    require_looks(FLAGS.weights, completer.config)
    blank = unfitted(training_features(completer, FLAGS.training))
    completer.calibration = blank
    views = completed_views(completer, VERDICT_SETS, FLAGS.limit, FLAGS.draws)
    scans = [scan for scan, *_ in views]
    points = completed_points(completer, FLAGS.limit or SIGMA_VIEWS, FLAGS.points)
    result = {
        "commit": commit(),
        "weights": FLAGS.weights,
        "weights_sha256": file_sha256(weights),
        "digests": {name: digest_of(*place) for name, place in SETS.items()},
        "calibration": fitted_verdicts(blank, scans).to_dict(),
        "trust": rightness(scans, judged_unseen(blank, scans)),
        **sigmas(points, FLAGS.points),
    }
    names = {"confidence": "trust", "sigma": "sigma"}
    both = [robustness.table(name, result[key]) for name, key in names.items()]
    print_and_write(result, "\n\n".join(both))


def run() -> None:
    """The entry point."""
    define_flags()
    launch("calibrate", main)


if __name__ == "__main__":
    run()
