"""Fits what gives completions a verdict, and measures it where it was not fitted.

    python -m experiments.trust --weights=FILE --output=FILE.json

Views of validation shapes and robot cells are turned, tilted, thinned, made noisy and
cropped (`experiments.shifts.any_shift`), and completed as a user's scan is. The
trees of `prism_jax.trust.Calibration` that ship are fitted on all of them; the table is
of verdicts by trees and bounds of trust that saw four fifths of the objects, and not
the one that is judged. `experiments.release --calibration=FILE.json` ships them.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from absl import flags
from jaxtyping import Bool, Float
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
from prism_jax.adaptation.config import PrismConfig
from prism_jax.cli.launch import launch
from prism_jax.completion import Completer
from prism_jax.data.datasets import digest_of, open_dataset, validation_split
from prism_jax.data.pipeline import Framing, frame_example
from prism_jax.evaluation.tables import short
from prism_jax.models.backbone import encode_points, partial_indices
from prism_jax.models.variables import Variables
from prism_jax.training.run import commit
from prism_jax.trust import EVIDENCE, Calibration, Verdict, logarithms
from prism_jax.weights import file_sha256, load_pretrained

FLAGS = flags.FLAGS

NUM_AXES = 16
"""Along which the features of training views vary most."""

DEPTH = 3
TREES = {
    "n_estimators": 150,
    "max_depth": DEPTH,
    "learning_rate": 0.03,
    "min_samples_leaf": 8,
}
"""A step size as small as that wants many."""

LOW_FOR_NOTHING = 0.1
"""Of the better half of objects that are left out, the share that may be called low."""

SETS = ("shapes", "roboarm")


class Sample(NamedTuple):
    """One completed view: of which set, object and shift; what was found, how large its
    workspace is, and its true CD-L1, both in half the longest side of the truth.
    Objects are numbered at random in each set: those with even numbers are fitted on.
    """

    data: str
    group: int
    shift: str
    evidence: dict[str, float]
    half_extent: float
    error: float


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "A name, or a file.")
    flags.DEFINE_integer("limit", None, "Views of each set, evenly spaced.", 4)
    flags.DEFINE_integer("draws", 3, "Shifts of each view.", lower_bound=1)
    flags.DEFINE_integer("training", 1000, "Training views that say what is familiar.")
    flags.DEFINE_string("data_dir", None, "Folder of the sets.")
    flags.DEFINE_bool("adapt", False, "Adapt to each view.")
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Completes, fits, measures, writes and prints the table."""
    prepare_output(FLAGS.output, ".json")
    weights = located(FLAGS.weights)
    config, variables = load_pretrained(weights)
    require_looks(FLAGS.weights, config)
    blank = unfitted(training_features(config, variables, FLAGS.training))
    completer = Completer(config, variables, calibration=blank)
    samples = list(completed_views(completer))
    result = {
        "commit": commit(),
        "weights": FLAGS.weights,
        "weights_sha256": file_sha256(weights),
        "digests": {name: digest_of(name, validation_split(name)) for name in SETS},
        "views": len(samples),
        "folds": FOLDS,
        "calibration": fitted(blank, samples).to_dict(),
        "trust": measured(samples, judged_unseen(blank, samples)),
    }
    print_and_write(result, trust_markdown(result))


def training_features(
    config: PrismConfig, variables: Variables, count: int
) -> Float[np.ndarray, "N G"]:
    """Global features of views as a training sees them."""
    model = config.model
    build_if_missing("shapes", "train", FLAGS.data_dir)
    source = open_dataset("shapes", "train", FLAGS.data_dir)
    framing = Framing(model.backbone.num_points, 1, model.margin, model.heading)

    @jax.jit
    def encode(partial: Float[np.ndarray, "N 3"]):
        indices = partial_indices(partial, model.backbone)
        encoded = encode_points(variables, model.backbone, partial, indices)
        return encoded.global_feature

    rows = np.linspace(0, len(source) - 1, min(count, len(source))).astype(int)
    features = []
    for row in tqdm(rows, desc="features", mininterval=2.0):
        rng = np.random.default_rng(row)
        batch = frame_example(source[int(row)], framing, rng)
        features.append(np.asarray(encode(batch.partial)))
    return np.array(features, np.float64)


def unfitted(features: Float[np.ndarray, "N G"]) -> Calibration:
    """One that knows what is familiar, and nothing of errors."""
    mean = features.mean(axis=0)
    off = features - mean
    _, spread, axes = np.linalg.svd(off, full_matrices=False)
    axes = axes[:NUM_AXES]
    rest = off - (off @ axes.T) @ axes
    spread = spread[: len(axes)] / np.sqrt(len(features))
    least = 1e-6 * max(float(spread[0]), 1e-6)  # equal features have no spread at all
    return Calibration(
        usual=np.zeros(len(EVIDENCE)),
        base=0.0,
        looks_at=np.zeros((1, 1)),
        thresholds=np.zeros((1, 1)),
        leaves=np.zeros((1, 2)),
        bounds=np.array([-20.0, 20.0]),
        fair=1.0,
        low=1.0,
        feature_mean=mean,
        feature_axes=axes / np.maximum(spread, least)[:, None],
        feature_rest=max(float(np.sqrt((rest**2).sum(axis=1).mean())), least),
    )


def completed_views(completer: Completer):
    """The samples of both sets."""
    for name in SETS:
        build_if_missing(name, validation_split(name), FLAGS.data_dir)
        views = validation_views(name, FLAGS.limit)
        count = 1 + max(view.group for view in views)
        group = numbered(count)
        with tqdm(total=len(views) * FLAGS.draws, desc=name, mininterval=2.0) as bar:
            for number, view in enumerate(views):
                for draw in range(FLAGS.draws):
                    rng = np.random.default_rng([number, draw])
                    shift, shifted = any_shift(view, rng)
                    done = completed(completer, shifted, FLAGS.adapt)
                    assert done.verdict is not None
                    unit = 0.5 * view.size
                    clouds = done.points / unit, shifted.complete / unit
                    yield Sample(
                        name,
                        int(group[view.group]),
                        shift,
                        done.verdict.evidence,
                        float(done.workspace.half_extent) / unit,
                        float(metrics.cd_l1(*clouds)),
                    )
                    bar.update()


def fitted(blank: Calibration, samples: list[Sample]) -> Calibration:
    """Boosted trees, and bounds of trust from what is said of objects that are left
    out."""
    found = np.array([logarithms(sample.evidence) for sample in samples])
    log_error = np.log([sample.error / sample.half_extent for sample in samples])
    sets = [sample.data for sample in samples]
    weights = np.array([len(sets) / sets.count(name) for name in sets])
    _, row = np.unique([sample.group for sample in samples], return_inverse=True)
    said = cross_predicted(found, log_error, weights, row % FOLDS, **TREES)
    # The mean of errors, and not that of their logarithms, is what is expected.
    lift = float(np.log(np.mean(np.exp(log_error)) / np.mean(np.exp(said))))
    good = log_error <= np.median(log_error)
    fair, low = _bounds_of_trust(log_error, said + lift)
    model = boosted(found, log_error, weights, **TREES)
    looks_at, thresholds, leaves = complete_trees(model, DEPTH)
    return dataclasses.replace(
        blank,
        usual=np.median(found[good], axis=0),
        base=float(model.init_.constant_.item()) + lift,
        looks_at=looks_at,
        thresholds=thresholds,
        leaves=leaves,
        bounds=np.array([log_error.min(), log_error.max()]),
        fair=fair,
        low=low,
    )


def _bounds_of_trust(
    log_error: Float[np.ndarray, " N"], predicted: Float[np.ndarray, " N"]
) -> tuple[float, float]:
    """Expected errors from which trust is fair, and low.

    Nine in ten of the worst tenth are low, if that leaves at most `LOW_FOR_NOTHING` of
    the better half low. Where fewer do, low is half-way between. High is at most half
    of all.
    """
    worst, better = worst_tenth(log_error), log_error <= np.median(log_error)
    least = np.quantile(predicted[better], 1.0 - LOW_FOR_NOTHING)
    low = 0.5 * (least + max(least, np.quantile(predicted[worst], 0.1)))
    fair = min(np.median(predicted), low)
    return float(np.exp(fair)), float(np.exp(low))


def judged_unseen(blank: Calibration, samples: list[Sample]) -> list[Verdict]:
    """The verdict on each sample by what was fitted on the objects of other folds."""
    fold = np.array([sample.group % FOLDS for sample in samples])
    verdicts = {}
    for number in tqdm(np.unique(fold), desc="folds", mininterval=2.0):
        others = [samples[row] for row in np.flatnonzero(fold != number)]
        calibration = Calibration.from_dict(fitted(blank, others).to_dict())
        for row in np.flatnonzero(fold == number):
            sample = samples[row]
            verdicts[row] = calibration.judge(sample.evidence, sample.half_extent)
    return [verdicts[row] for row in range(len(samples))]


def worst_tenth(error: Float[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Those with the largest errors."""
    return error >= np.quantile(error, 0.9)


def measured(samples: list[Sample], verdicts: list[Verdict]) -> dict[str, Any]:
    """How far verdicts are right, over all samples, by set and by shift."""
    judged = list(zip(samples, verdicts, strict=True))
    parts = {"all": judged}
    for name in SETS:
        parts[name] = [pair for pair in judged if pair[0].data == name]
    for shift in sorted({sample.shift for sample in samples}):
        parts[shift] = [pair for pair in judged if pair[0].shift == shift]
    return {
        name: _rightness(*zip(*part, strict=True))
        for name, part in parts.items()
        if part
    }


def _rightness(
    samples: tuple[Sample, ...], verdicts: tuple[Verdict, ...]
) -> dict[str, Any]:
    expected = np.array([verdict.expected_error for verdict in verdicts])
    trust = np.array([verdict.trust for verdict in verdicts])
    error = np.array([sample.error for sample in samples])
    better = error <= np.median(error)
    return {
        "views": len(samples),
        "error": float(error.mean()),
        "expected": float(expected.mean()),
        "rank_correlation": rank_correlation(expected, error),
        "worst_tenth_low": float((trust[worst_tenth(error)] == "low").mean()),
        "better_half_low": float((trust[better] == "low").mean()),
        "low": float((trust == "low").mean()),
        "high": float((trust == "high").mean()),
        "error_of_low": _mean(error[trust == "low"]),
        "error_of_high": _mean(error[trust == "high"]),
    }


def _mean(values: Float[np.ndarray, " N"]) -> float | None:
    return float(values.mean()) if len(values) else None


def trust_markdown(result: Mapping[str, Any]) -> str:
    """A row for all views, for each set and for each shift."""
    lines = [
        f"`{result['weights']}`, commit {short(result['commit'] or 'unknown')}, "
        f"{result['views']:,} shifted validation views, each judged by what was fitted "
        f"on other objects ({result['folds']} folds). Errors are CD-L1 x1e3. "
        f"Unit of length: {metrics.UNIT}.\n",
        "| views | number | error | expected | rank correlation | of the worst tenth "
        "low | of the better half low | low | high | error of low | error of high |",
        "| --- |" + " --- |" * 10,
    ]
    for name, row in result["trust"].items():
        shares = (row[k] for k in ("worst_tenth_low", "better_half_low", "low", "high"))
        ends = (row["error_of_low"], row["error_of_high"])
        cells = [
            name,
            f"{row['views']:,}",
            f"{1e3 * row['error']:.4g}",
            f"{1e3 * row['expected']:.4g}",
            _or_dash(row["rank_correlation"], ".2f"),
            *(f"{share:.0%}" for share in shares),
            *(_or_dash(end, ".4g", 1e3) for end in ends),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _or_dash(value: float | None, form: str, factor: float = 1.0) -> str:
    return "-" if value is None else format(factor * value, form)


def run() -> None:
    """The entry point."""
    define_flags()
    launch("trust", main)


if __name__ == "__main__":
    run()
