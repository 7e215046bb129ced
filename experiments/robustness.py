"""Measures how rotation, tilt, sparsity, noise and cropping affect completions.

    python -m experiments.robustness --weights=small --output=FILE.json

Every view of a validation split is changed and completed like a user's scan. A change
applies to the partial cloud, its sensor and their frame; the ground truth follows.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from absl import flags
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.scoring import print_and_write
from experiments.simulation.build_dataset import build_if_missing
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.assembly import CompletedScan
from prism_jax.completion.completer import Completer
from prism_jax.completion.filtering import densify
from prism_jax.completion.weights import sha256
from prism_jax.data.datasets import digest_of, open_dataset, validation_split
from prism_jax.data.pipeline import with_partial
from prism_jax.evaluation import metrics
from prism_jax.evaluation.tables import table_lines
from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import choose
from prism_jax.preprocessing.segmentation.support import find_up
from prism_jax.training.run import commit

FLAGS = flags.FLAGS

TILT = 36.0
TABLE_SIDE = 3.0
"""Of the table under a tilted object, in the object's longest side."""

COLUMNS = {
    "CD-L2 x1e4": ("cd_l2", np.mean, 1e4),
    "median": ("cd_l2", np.median, 1e4),
    "prediction to truth x1e4": ("prediction_to_truth", np.mean, 1e4),
    "truth to prediction x1e4": ("truth_to_prediction", np.mean, 1e4),
    "CD-L1 x1e3": ("cd_l1", np.mean, 1e3),
}


@dataclasses.dataclass(frozen=True)
class View:
    """A partial cloud, where its sensor stood, and the truth, all in one frame.

    `table` are points of what the object stands on, where that is in the view; `size`
    is the longest side of the truth's box before any turn, `group` the object's number.
    """

    partial: Float[np.ndarray, "N 3"]
    complete: Float[np.ndarray, "M 3"]
    eye: Float[np.ndarray, "3"] | None
    size: float
    table: Float[np.ndarray, "T 3"] | None = None
    group: int = 0


def turned(view: View, rotation: Rotation) -> View:
    """All of it about the origin."""
    matrix = rotation.as_matrix()
    clouds = {
        name: cloud @ matrix.T
        for name in ("partial", "complete", "eye", "table")
        if (cloud := getattr(view, name)) is not None
    }
    return dataclasses.replace(view, **clouds)


def heading(view: View, rng: np.random.Generator, degrees: float) -> View:
    """Turned about the vertical."""
    return turned(view, Rotation.from_euler("z", degrees, True))


def tilted(view: View, rng: np.random.Generator) -> View:
    """By `TILT` about a random horizontal axis, at a random heading, on a table.

    The table is as dense as the object, noisy by a thousandth of its size, and without
    what the object covers.
    """
    lower, upper = view.complete.min(axis=0), view.complete.max(axis=0)
    count = int(len(view.partial) * TABLE_SIDE**2 / 3)
    table = np.empty((count, 3))
    middle = 0.5 * (lower + upper)[:2]
    table[:, :2] = middle + rng.uniform(-0.5, 0.5, (count, 2)) * TABLE_SIDE * view.size
    table[:, 2] = lower[2] + rng.normal(0.0, 1e-3 * view.size, count)
    under = ((table > lower) & (table < upper))[:, :2].all(axis=1)
    angle = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    turn = Rotation.from_rotvec(np.deg2rad(TILT) * axis)
    turn = turn * Rotation.from_euler("z", rng.uniform(0, 360), True)
    return turned(dataclasses.replace(view, table=table[~under]), turn)


def with_points(view: View, rng: np.random.Generator, count: int) -> View:
    """Thinned at random, or made denser between its points."""
    partial = view.partial
    if count > len(partial):
        partial = densify(partial, count / len(partial))
    else:
        partial = partial[rng.permutation(len(partial))[:count]]
    return dataclasses.replace(view, partial=partial)


def noisy(view: View, rng: np.random.Generator, share: float) -> View:
    """Gaussian in each coordinate, of a share of the object's longest side."""
    noise = rng.normal(0.0, share * view.size, view.partial.shape)
    return dataclasses.replace(view, partial=view.partial + noise)


def cropped(view: View, rng: np.random.Generator, share: float) -> View:
    """Without that share of the points that lies farthest in some direction."""
    along = view.partial @ rng.normal(size=3)
    kept = along <= np.quantile(along, 1.0 - share)
    return dataclasses.replace(view, partial=view.partial[kept])


def any_shift(view: View, rng: np.random.Generator) -> tuple[str, View]:
    """One of every kind, of random strength, at a random heading; and what it is."""
    kind = str(rng.choice(["heading", "tilt", "points", "noise", "crop"]))
    shifted = heading(view, rng, rng.uniform(0, 360))
    if kind == "tilt":
        shifted = tilted(shifted, rng)
    elif kind == "points":
        count = int(np.exp(rng.uniform(np.log(100), np.log(20_000))))
        shifted = with_points(shifted, rng, count)
    elif kind == "noise":
        shifted = noisy(shifted, rng, rng.uniform(0.0, 0.03))
    elif kind == "crop":
        shifted = cropped(shifted, rng, rng.uniform(0.05, 0.6))
    return kind, shifted


DENSITIES = (100, 500, 2_000, 20_000, 200_000)
SHIFTS: dict[str, Callable[[View, np.random.Generator], View]] = {
    **{f"heading {n}": partial(heading, degrees=n) for n in range(0, 360, 45)},
    f"tilt {TILT:g}, on a table": tilted,
    **{f"{n:,} points": partial(with_points, count=n) for n in DENSITIES},
    **{f"noise {n:g} %": partial(noisy, share=n / 100) for n in (0.5, 1, 2)},
    **{f"cropped by {n} %": partial(cropped, share=n / 100) for n in (10, 30, 50)},
}
"""By the names that tables give them."""


def views_of(dataset: str, split: str, limit: int | None = None) -> list[View]:
    """All views of a split, which is built if it is missing, or so many of them, evenly
    spaced."""
    build_if_missing(dataset, split)
    source = open_dataset(dataset, split)
    count = min(len(source), limit or len(source))
    views = []
    for row in np.linspace(0, len(source) - 1, count).astype(int):
        example = with_partial(source[int(row)])
        clouds = (example.partial, example.complete, example.eye)
        double = [None if c is None else c.astype(np.float64) for c in clouds]
        assert example.complete is not None
        size = float(np.ptp(example.complete, axis=0).max())
        group = int(source.objects[row])
        views.append(View(*double, size, group=group))  # pyright: ignore
    return views


def completed(completer: Completer, view: View) -> CompletedScan:
    """As a user's scan is. A view with a table, with the way up that the table says."""
    camera, up = None, "z"
    if view.eye is not None:
        camera = Camera.look_at(view.eye, view.partial.mean(axis=0))
    if view.table is not None:
        up = find_up(np.concatenate([view.partial, view.table]), view.eye).vector
    return completer.complete(view.partial, camera, up=up)


def scored(view: View, points: Float[np.ndarray, "N 3"]) -> list[float]:
    """The metrics of `COLUMNS`."""
    unit = 0.5 * view.size
    found = metrics.score(points / unit, view.complete / unit).named()
    return [found[metric] for metric, _, _ in COLUMNS.values()]


def summary(scores: Sequence[Sequence[float]]) -> dict[str, float]:
    """Of what `scored` says of each view."""
    columns = zip(COLUMNS.items(), zip(*scores, strict=True), strict=True)
    return {
        title: factor * float(mean(values))
        for (title, (_, mean, factor)), values in columns
    }


def table(title: str, rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Rows of numbers, under the names that the result has for them."""
    heads = list(next(iter(rows.values())))
    cells = [
        [name, *("-" if n is None else f"{n:.4g}" for n in row.values())]
        for name, row in rows.items()
    ]
    return "\n".join(table_lines([title, *heads], cells))


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "Weights, name or file.")
    flags.DEFINE_enum(
        "dataset", "shapes", ("shapes", "roboarm"), "Data set to validate on."
    )
    flags.DEFINE_integer("limit", None, "Views to use, evenly spaced.", lower_bound=1)
    flags.DEFINE_multi_string("shift", list(SHIFTS), "Shifts to apply.")
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Shifts, completes, scores, prints the table and writes the result."""
    prepare_output(FLAGS.output, ".json")
    for name in FLAGS.shift:
        choose("shift", name, SHIFTS)
    completer = Completer.from_pretrained(located(FLAGS.weights))
    split = validation_split(FLAGS.dataset)
    views = views_of(FLAGS.dataset, split, FLAGS.limit)
    rows = {}
    for name in FLAGS.shift:
        scores = {"partial": [], "completed": []}
        for number, view in enumerate(tqdm(views, desc=name, mininterval=2.0)):
            shifted = SHIFTS[name](view, np.random.default_rng(number))
            done = completed(completer, shifted)
            scores["partial"].append(scored(shifted, shifted.partial))
            scores["completed"].append(scored(shifted, done.points))
        means = {cloud: summary(own) for cloud, own in scores.items()}
        rows[name] = {"views": len(views), **means}
    result = {
        "commit": commit(),
        "data": f"{FLAGS.dataset}, {split}",
        "digest": digest_of(FLAGS.dataset, split),
        "weights": FLAGS.weights,
        "variables_sha256": sha256(completer.variables),
        "shifts": rows,
    }
    print_and_write(
        result, table("shift", {k: v["completed"] for k, v in rows.items()})
    )


def run() -> None:
    """The entry point."""
    define_flags()
    launch("robustness", main)


if __name__ == "__main__":
    run()
