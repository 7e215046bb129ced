"""What each reason to leave predicted points away does to completions.

    python -m experiments.filters --weights=small --dataset=roboarm --shift="heading 0"

On shifted views of a validation split (`experiments.shifts`), not adapted and as sparse
as predicted. Of the added points those are left away that a rule finds, and the change
of CD-L2 is told, over all and in how many views it falls and rises.
"""

import jax
import numpy as np
from absl import flags
from scipy.spatial import KDTree
from tqdm import tqdm

from experiments.shifts import SHIFTS, View, validation_views
from experiments.weights import located
from prism_jax import metrics
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.cli.launch import launch
from prism_jax.io.errors import choose
from prism_jax.observation.observation import observe
from prism_jax.observation.visibility import in_front, looked_through
from prism_jax.selection import disputed, keep_unmeasured, usual_spacing
from prism_jax.weights import load_pretrained

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "A name, or a file.")
    flags.DEFINE_enum("dataset", "shapes", ("shapes", "roboarm"), "Whose validation.")
    flags.DEFINE_string("shift", "heading 0", "One of experiments.shifts.")
    flags.DEFINE_integer("limit", 40, "So many views, evenly spaced.", lower_bound=1)


def main() -> None:
    """Completes, leaves away by each rule, and prints the table."""
    shift = SHIFTS[choose("--shift", FLAGS.shift, SHIFTS)]
    config, variables = load_pretrained(located(FLAGS.weights))
    model = config.model
    complete = jax.jit(make_adapt(config.with_adapt(num_steps=0)))
    scores: dict[str, list[float]] = {}
    views = validation_views(FLAGS.dataset, FLAGS.limit)
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
        found = rules(prediction, measured, partial, eye, model.poses)
        for name, away in found.items():
            cloud = np.concatenate([measured, prediction[new & ~away]])
            users = np.asarray(seen.workspace.from_unit(cloud))
            score = cd_l2(users, shifted)
            scores.setdefault(name, []).append(score)
    print(filters_markdown(scores))


def rules(
    prediction: np.ndarray,
    measured: np.ndarray,
    partial: np.ndarray,
    eye: np.ndarray,
    poses: int = 1,
) -> dict[str, np.ndarray]:
    """Which predicted points each rule leaves away."""
    spacing = usual_spacing(partial)
    near = KDTree(np.concatenate([prediction, measured])).query(prediction, k=3)[0]
    outside = (np.abs(prediction) > 1.0).any(axis=1)
    found = {"none": np.zeros(len(prediction), bool), "outside": outside}
    for reach in (0.1, 0.2, 0.3):
        found[f"second neighbour beyond {reach}"] = near[:, 2] > reach
    if poses > 1:
        for reach in (0.1, 0.15, 0.2, 0.3):
            found[f"other poses beyond {reach}"] = disputed(prediction, poses, reach)
        found["other poses"] = np.arange(len(prediction)) >= len(prediction) // poses
    for tolerance in (2.0, 4.0, 8.0):
        hides = in_front(prediction, measured, eye, spacing, tolerance)
        found[f"in front by {tolerance:g} spacings"] = hides
    for reach in (5.0, 12.0):
        found[f"looked through, {reach:g} spacings about"] = looked_through(
            prediction, measured, eye, reach * spacing
        )
    return found


def cd_l2(cloud: np.ndarray, view: View) -> float:
    """In the unit of scores."""
    unit = 0.5 * view.size
    return metrics.cd_l2(cloud / unit, view.complete / unit)


def filters_markdown(scores: dict[str, list[float]]) -> str:
    """A row for each rule."""
    lines = [
        f"`{FLAGS.weights}` on {FLAGS.dataset}, validation, {FLAGS.shift}, "
        f"{len(scores['none'])} views.\n",
        "| left away | CD-L2 x1e4 | median | change | falls in | rises in |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    before = np.array(scores["none"])
    for name, values in scores.items():
        after = np.array(values)
        change = after.mean() / before.mean() - 1
        lines.append(
            f"| {name} | {1e4 * after.mean():.4g} | {1e4 * np.median(after):.4g} | "
            f"{change:+.1%} | {(after < before).mean():.0%} | "
            f"{(after > before).mean():.0%} |"
        )
    return "\n".join(lines) + "\n"


def run() -> None:
    """The entry point."""
    define_flags()
    launch("filters", main)


if __name__ == "__main__":
    run()
