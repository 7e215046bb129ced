"""Fits the confidence of completions and the sigma of points, and measures both.

    python -m experiments.calibrate --weights=small --output=FILE.json

Validation views are shifted at random and completed as a user's scan is. Two sums of
trees are fitted on the results: `prism_jax.uncertainty.confidence` expects the error of
a completion, `prism_jax.uncertainty.sigma` that of each point. Both are measured on
objects that the trees did not see. `experiments.release --calibration=FILE.json` adds
them to the weights.
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

from experiments.output import prepare_output
from experiments.robustness import View, any_shift, completed, table, views_of
from experiments.scoring import print_and_write, require_looks
from experiments.simulation.build_dataset import build_if_missing
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.completer import Completer
from prism_jax.completion.weights import file_sha256, load_pretrained
from prism_jax.data.datasets import digest_of, open_dataset
from prism_jax.data.pipeline import Framing, frame_example
from prism_jax.evaluation import metrics
from prism_jax.io.errors import require
from prism_jax.models.backbone import encode_points, partial_indices
from prism_jax.training.run import commit
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
FLAT = (
    0.15  # how far a patch's points lie off the plane, in how far they reach along it
)

NOTHING = {"base": 0.0, "looks_at": np.zeros((1, 1)), "thresholds": np.zeros((1, 1))}
NOTHING |= {"leaves": np.zeros((1, 2)), "bounds": np.array([-20.0, 20.0])}
"""The fields of trees that are not fitted yet."""


class Scan(NamedTuple):
    """A completed view, for the verdict. Objects are numbered at random; `half_extent`
    of the workspace and `error`, CD-L1, are in half the longest side of the truth."""

    data: str
    group: int
    shift: str
    evidence: dict[str, float]
    half_extent: float
    error: float


class Points(NamedTuple):
    """Points of a completed view, for sigma: the network's that were added, with clues
    and distances from the true surface, and some of all that a user gets besides.
    Lengths are in the unit workspace; `unit` turns them into those of `Scan`."""

    data: str
    group: int
    shift: str
    unit: float
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
        indices = partial_indices(partial, model.backbone)
        encoded = encode_points(variables, model.backbone, partial, indices)
        return encoded.global_feature

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
    return Calibration(
        **NOTHING,
        usual=np.zeros(len(EVIDENCE)),
        fair=1.0,
        low=1.0,
        feature_mean=mean,
        feature_axes=axes / np.maximum(scale, least)[:, None],
        feature_rest=max(float(np.sqrt((rest**2).sum(axis=1).mean())), least),
    )


def shifted(
    names: Iterable[str], limit: int | None, draws: int | None
) -> Iterator[tuple[tuple[str, int, str], View, np.random.Generator]]:
    """Views of each set, each shifted at random, in as many ways as there are draws (or
    in one of the set's own): set, object and shift; the view; its random numbers."""
    for name in names:
        views = views_of(*SETS[name], limit)
        group = np.random.default_rng(0).permutation(1 + max(v.group for v in views))
        for number, view in enumerate(tqdm(views, desc=name, mininterval=2.0)):
            for draw in range(draws) if draws else [len(name)]:
                rng = np.random.default_rng([number, draw])
                shift, moved = any_shift(view, rng)
                yield (name, int(group[view.group]), shift), moved, rng


def completed_scans(completer: Completer, limit: int | None, draws: int) -> list[Scan]:
    """What the verdict is fitted on, of a completer that finds evidence."""
    scans = []
    for place, view, _ in shifted(VERDICT_SETS, limit, draws):
        done, unit = completed(completer, view), 0.5 * view.size
        assert done.verdict is not None
        error = float(metrics.cd_l1(done.points / unit, view.complete / unit))
        half_extent = float(done.workspace.half_extent) / unit
        scans.append(Scan(*place, done.verdict.evidence, half_extent, error))
    return scans


def completed_points(completer: Completer, limit: int, count: int) -> list[Points]:
    """What sigma is fitted on, with so many of the points that a user gets."""
    completer.point_errors = listener = Listener(**NOTHING)
    found = []
    for place, view, rng in shifted(SETS, limit, None):
        done = completed(completer, view)
        points = np.asarray(done.workspace.to_unit(done.points[~done.observed]))
        truth = np.asarray(done.workspace.to_unit(view.complete))
        unit = float(done.workspace.half_extent) / (0.5 * view.size)
        kept = points[: len(listener.asked)]  # the network's own come first
        own = kept, listener.asked, from_surface(kept, truth)
        added = _some(points, count, rng)
        found.append(Points(*place, unit, *own, added, from_surface(added, truth)))
    return found


def from_surface(points: Cloud, truth: Cloud) -> Row:
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


def _some(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """So many of the rows, or all."""
    if len(rows) <= count:
        return rows
    return rows[np.sort(rng.choice(len(rows), count, replace=False))]


def boosted(
    found: Table, wanted: Row, sets: Sequence[str], fold: np.ndarray, settings: Any
) -> tuple[dict[str, Any], Row, Row]:
    """Gradient boosting (Friedman 2001) by scikit-learn, the same every time: fields of
    `Trees`; what trees that saw all other folds say of each sample; and the samples'
    weights, by which all sets weigh the same."""
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
    """The verdict's trees, and bounds of trust from what is said of objects that are
    left out."""
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
    fields |= {
        "base": fields["base"] + lift,
        "usual": np.median(found[better], axis=0),
        "fair": float(np.exp(min(np.median(said), low))),
        "low": float(np.exp(low)),
    }
    return dataclasses.replace(blank, **fields)


def judged_unseen(blank: Calibration, scans: Sequence[Scan]) -> list[Verdict]:
    """The verdict on each scan by what was fitted on the objects of other folds."""
    fold = np.array([scan.group % FOLDS for scan in scans])
    judges = {}
    for number in np.unique(fold):
        others = [one for one in scans if one.group % FOLDS != number]
        fitted = fitted_verdicts(blank, others).to_dict()
        judges[number] = Calibration.from_dict(fitted).judge
    pairs = zip(scans, fold, strict=True)
    return [judges[number](scan.evidence, scan.half_extent) for scan, number in pairs]


def by_part(samples: Sequence[Scan] | Sequence[Points], measure: Any) -> dict[str, Any]:
    """A measure of the numbers of all samples, of each set's and of each shift's."""
    sets, shifts = np.array([(one.data, one.shift) for one in samples]).T
    parts = {"all": sets == sets}
    parts |= {name: sets == name for name in dict.fromkeys(sets.tolist())}
    parts |= {name: shifts == name for name in np.unique(shifts).tolist()}
    return {name: measure(np.flatnonzero(part)) for name, part in parts.items()}


def rightness(scans: Sequence[Scan], verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """How far verdicts are right, over all scans, by set and by shift."""
    expected = np.array([verdict.expected_error for verdict in verdicts])
    trust = np.array([verdict.trust for verdict in verdicts])
    error = np.array([scan.error for scan in scans])

    def measure(rows):
        own, low, high = error[rows], trust[rows] == "low", trust[rows] == "high"
        return {
            "views": len(own),
            "error": float(own.mean()),
            "expected": float(expected[rows].mean()),
            "rank_correlation": rank_correlation(expected[rows], own),
            "worst_tenth_low": float(low[own >= np.quantile(own, 0.9)].mean()),
            "better_half_low": float(low[own <= np.median(own)].mean()),
            "low": float(low.mean()),
            "high": float(high.mean()),
            "error_of_low": float(own[low].mean()) if low.any() else None,
            "error_of_high": float(own[high].mean()) if high.any() else None,
        }

    return by_part(scans, measure)


def rank_correlation(first: Row, second: Row) -> float | None:
    """Spearman's; None where all of one are equal."""
    if len(first) == 0 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(spearmanr(first, second)[0])  # pyright: ignore


def fitted_sigmas(samples: Sequence[Points], count: int) -> PointErrors:
    """Sigma's trees, from so many points of each view."""
    rng = np.random.default_rng(0)
    rows = [_some(np.arange(len(sample.kept)), count, rng) for sample in samples]
    pairs = list(zip(samples, rows, strict=True))
    clues = np.concatenate([sample.clues[row] for sample, row in pairs])
    errors = np.concatenate([sample.errors[row] for sample, row in pairs])
    sets = [sample.data for sample, row in pairs for _ in row]
    fold = np.array([sample.group // 2 % FOLDS for sample, row in pairs for _ in row])
    wanted = np.log(np.maximum(errors, LEAST))
    fields, said, weights = boosted(clues, wanted, sets, fold, SIGMA_TREES)
    # From the mean of logarithms to the logarithm of the mean.
    mean, found = (np.average(x, weights=weights) for x in (errors, np.exp(said)))
    fields["base"] += float(np.log(mean / found))
    return PointErrors(**fields)


def sigma_rightness(found: PointErrors, samples: Sequence[Points]) -> dict[str, Any]:
    """How far sigmas of the points that a user gets are right, over all views, by set
    and by shift. Lengths are in half the longest side of the truth."""
    sigmas = [
        sample.unit * spread(sample.added, sample.kept, found.sigma(sample.clues))
        for sample in samples
    ]
    errors = [sample.unit * sample.added_errors for sample in samples]

    def measure(rows):
        views = [(sigmas[row], errors[row]) for row in rows]
        sigma, error = map(np.concatenate, zip(*views, strict=True))
        within = [rank_correlation(*view) for view in views]
        return {
            "views": len(views),
            "points": len(error),
            "expected": float(sigma.mean()),
            "error": float(error.mean()),
            "below_one": float((error < sigma).mean()),
            "below_two": float((error < 2 * sigma).mean()),
            "holds_95": float(np.quantile(error / sigma, 0.95)),
            "rank_correlation": rank_correlation(sigma, error),
            "within_views": float(
                np.median([r for r in within if r is not None] or [0])
            ),
        }

    return by_part(samples, measure)


def sigmas(samples: Sequence[Points], count: int) -> dict[str, Any]:
    """The fit on objects of even numbers, and how far it is right about the others."""
    samples = [sample for sample in samples if len(sample.kept)]
    even, odd = ([s for s in samples if s.group % 2 == half] for half in (0, 1))
    fields = fitted_sigmas(even, count).to_dict()
    return {
        "point_errors": fields,
        "sigma": sigma_rightness(PointErrors.from_dict(fields), odd),
        "views": {"fitted": len(even), "held_out": len(odd)},
    }


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
    scans = completed_scans(completer, FLAGS.limit, FLAGS.draws)
    completer.calibration = None
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
    both = table("confidence", result["trust"]), table("sigma", result["sigma"])
    print_and_write(result, "\n\n".join(both))


def run() -> None:
    """The entry point."""
    define_flags()
    launch("calibrate", main)


if __name__ == "__main__":
    run()
