"""What each reason to leave predicted points away does to completions.

    python -m experiments.filters --weights=small --dataset=roboarm --shift="heading 0"

On shifted views of a validation split (`experiments.shifts`), not adapted and as sparse
as predicted. Of the new points those are left away that a rule finds; "none" leaves
nothing away, "all that are" what a user's completion leaves away. Told are the changes
of CD-L1 and CD-L2 over all views, and in how many CD-L2 falls and rises.
"""

import jax
import numpy as np
from absl import flags
from tqdm import tqdm

from experiments.shifts import SHIFTS, validation_views
from experiments.weights import located
from prism_jax import metrics
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.cli.launch import launch
from prism_jax.data.datasets import DATASETS
from prism_jax.io.errors import choose
from prism_jax.observation.observation import observe
from prism_jax.observation.visibility import in_front, looked_through
from prism_jax.selection import (
    company,
    keep_unmeasured,
    lonely,
    select,
    usual_spacing,
)
from prism_jax.weights import load_pretrained

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "A name, or a file.")
    flags.DEFINE_enum("dataset", "shapes", DATASETS, "Whose views.")
    flags.DEFINE_string("split", None, "Of it; validation if not given.")
    flags.DEFINE_string("data_dir", None, "Its folder, if it has none of its own.")
    flags.DEFINE_string("shift", "heading 0", "One of experiments.shifts.")
    flags.DEFINE_integer("limit", 40, "So many views, evenly spaced.", lower_bound=1)


def main() -> None:
    """Completes, leaves away by each rule, and prints the table."""
    shift = SHIFTS[choose("--shift", FLAGS.shift, SHIFTS)]
    config, variables = load_pretrained(located(FLAGS.weights))
    model = config.model
    complete = jax.jit(make_adapt(config.with_adapt(num_steps=0)))
    scores: dict[str, list[dict[str, float]]] = {}
    place = FLAGS.dataset, FLAGS.limit, FLAGS.split, FLAGS.data_dir
    views = validation_views(*place)
    for number, view in enumerate(tqdm(views, mininterval=2.0)):
        shifted = shift(view, np.random.default_rng(number))
        seen = observe(
            shifted.partial, shifted.eye, margin=model.margin, heading=model.heading
        )
        read = seen.sampled(model.backbone.num_points)
        prediction = complete(variables, read.partial, read.camera).points
        prediction = np.asarray(prediction, np.float64)
        measured, partial = np.asarray(seen.partial), np.asarray(read.partial)
        eye = np.asarray(seen.eye)
        new = keep_unmeasured(prediction, measured, partial)
        found = rules(prediction, measured, partial, eye)
        at = eye if seen.sensor_known else None
        kept = select(prediction, measured, partial, at).kept
        found = {"none": found.pop("none"), "all that are": new & ~kept, **found}
        unit = 0.5 * shifted.size
        for name, away in found.items():
            cloud = np.concatenate([measured, prediction[new & ~away]])
            users = np.asarray(seen.workspace.from_unit(cloud))
            score = metrics.score(users / unit, shifted.complete / unit)
            scores.setdefault(name, []).append(score.named())
    print(filters_markdown(scores))


def rules(
    prediction: np.ndarray,
    measured: np.ndarray,
    partial: np.ndarray,
    eye: np.ndarray,
) -> dict[str, np.ndarray]:
    """Which predicted points each rule leaves away."""
    spacing = usual_spacing(partial)
    outside = (np.abs(prediction) > 1.0).any(axis=1)
    found = {"none": np.zeros(len(prediction), bool), "outside": outside}
    usual = company(len(prediction))
    for count in (2, usual // 2, usual, 2 * usual):
        for reach in (0.15, 0.25, 0.35, 0.45):
            name = f"fewer than {count} others within {reach}"
            found[name] = lonely(prediction, measured, reach, count)
    for tolerance in (2.0, 4.0, 8.0):
        hides = in_front(prediction, measured, eye, spacing, tolerance)
        found[f"in front by {tolerance:g} spacings"] = hides
    for reach in (5.0, 12.0):
        found[f"looked through, {reach:g} spacings about"] = looked_through(
            prediction, measured, eye, reach * spacing
        )
    return found


def filters_markdown(scores: dict[str, list[dict[str, float]]]) -> str:
    """A row for each rule."""
    split = FLAGS.split or "validation"
    lines = [
        f"`{FLAGS.weights}` on {FLAGS.dataset}, {split}, {FLAGS.shift}, "
        f"{len(scores['none'])} views.\n",
        "| left away | CD-L2 x1e4 | median | CD-L1 x1e3 | HD x1e2 | change of CD-L2 | "
        "of CD-L1 | CD-L2 falls in | rises in |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]

    def of(name: str, metric: str) -> np.ndarray:
        return np.array([score[metric] for score in scores[name]])

    for name in scores:
        l1, l2 = of(name, "cd_l1"), of(name, "cd_l2")
        before = of("none", "cd_l2")
        lines.append(
            f"| {name} | {1e4 * l2.mean():.4g} | {1e4 * np.median(l2):.4g} | "
            f"{1e3 * l1.mean():.4g} | {1e2 * of(name, 'hausdorff').mean():.4g} | "
            f"{l2.mean() / before.mean() - 1:+.1%} | "
            f"{l1.mean() / of('none', 'cd_l1').mean() - 1:+.1%} | "
            f"{(l2 < before).mean():.0%} | {(l2 > before).mean():.0%} |"
        )
    return "\n".join(lines) + "\n"


def run() -> None:
    """The entry point."""
    define_flags()
    launch("filters", main)


if __name__ == "__main__":
    run()
