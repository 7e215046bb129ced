"""Measures how rotation, tilt, sparsity, noise and cropping affect completions.

    python -m experiments.robustness --weights=small --output=FILE.json

Every view of a validation split is changed and completed like a user's scan. A change
applies to the partial cloud, its sensor and their frame; the ground truth follows.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from absl import flags
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.run_folder import commit
from experiments.scoring import print_and_write
from experiments.simulation.build_dataset import build_if_missing
from experiments.splits import digest_of, validation_split
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.assembly import CompletedScan
from prism_jax.completion.completer import Completer
from prism_jax.completion.filtering import densify
from prism_jax.completion.weights import sha256
from prism_jax.data.datasets import open_dataset
from prism_jax.data.pipeline import with_partial
from prism_jax.evaluation import metrics
from prism_jax.evaluation.tables import table_lines
from prism_jax.geometry.camera import Camera
from prism_jax.preprocessing.segmentation.support import find_up

FLAGS = flags.FLAGS
Cloud = Float[np.ndarray, "N 3"]

TILT = 36.0
TABLE_SIDE = 3.0  # of the table under a tilted object, in the object's longest side


class View(NamedTuple):
    """A partial cloud, where its sensor stood, and the truth, all in one frame; the
    longest side of the truth's box before any turn; the object's number; and points of
    what the object stands on, where that is in the view."""

    partial: Cloud
    complete: Cloud
    eye: Float[np.ndarray, "3"] | None
    size: float
    group: int = 0
    table: Cloud | None = None


def turned(view: View, rotation: Rotation) -> View:
    """All of it about the origin."""
    matrix, names = rotation.as_matrix(), ("partial", "complete", "eye", "table")
    clouds = {n: c @ matrix.T for n in names if (c := getattr(view, n)) is not None}
    return view._replace(**clouds)


def heading(view: View, rng: np.random.Generator, degrees: float) -> View:
    """Turned about the vertical."""
    return turned(view, Rotation.from_euler("z", degrees, True))


def tilted(view: View, rng: np.random.Generator) -> View:
    """By `TILT` about a random level axis, at a random heading, on a table. That is as
    dense as the object, noisy by a thousandth of its size, and hidden below it."""
    lower, upper = view.complete.min(axis=0), view.complete.max(axis=0)
    count = int(len(view.partial) * TABLE_SIDE**2 / 3)
    places = rng.uniform(-0.5, 0.5, (count, 2)) * TABLE_SIDE * view.size
    places = 0.5 * (lower + upper)[:2] + places
    heights = lower[2] + rng.normal(0.0, 1e-3 * view.size, count)
    covered = ((places > lower[:2]) & (places < upper[:2])).all(axis=1)
    table = np.column_stack([places, heights])[~covered]
    angle = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    turn = Rotation.from_rotvec(np.deg2rad(TILT) * axis)
    turn = turn * Rotation.from_euler("z", rng.uniform(0, 360), True)
    return turned(view._replace(table=table), turn)


def with_points(view: View, rng: np.random.Generator, count: int) -> View:
    """Thinned at random, or made denser between its points."""
    if count > len(view.partial):
        return view._replace(partial=densify(view.partial, count / len(view.partial)))
    kept = rng.permutation(len(view.partial))[:count]
    return view._replace(partial=view.partial[kept])


def noisy(view: View, rng: np.random.Generator, share: float) -> View:
    """Gaussian in each coordinate, of a share of the object's longest side."""
    noise = rng.normal(0.0, share * view.size, view.partial.shape)
    return view._replace(partial=view.partial + noise)


def cropped(view: View, rng: np.random.Generator, share: float) -> View:
    """Without that share of the points that lies farthest in some direction."""
    along = view.partial @ rng.normal(size=3)
    return view._replace(partial=view.partial[along <= np.quantile(along, 1.0 - share)])


KINDS: dict[str, Callable[[View, np.random.Generator], View]] = {  # of any strength
    "heading": lambda view, rng: view,
    "tilt": tilted,
    "points": lambda view, rng: with_points(
        view, rng, int(np.exp(rng.uniform(np.log(100), np.log(20_000))))
    ),
    "noise": lambda view, rng: noisy(view, rng, rng.uniform(0.0, 0.03)),
    "crop": lambda view, rng: cropped(view, rng, rng.uniform(0.05, 0.6)),
}


def any_shift(view: View, rng: np.random.Generator) -> tuple[str, View]:
    """One of `KINDS`, at a random heading; and which."""
    kind = str(rng.choice(list(KINDS)))
    return kind, KINDS[kind](heading(view, rng, rng.uniform(0, 360)), rng)


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
        size = float(np.ptp(np.asarray(example.complete), axis=0).max())
        views.append(View(*double, size, int(source.objects[row])))  # pyright: ignore
    return views


def completed(completer: Completer, view: View, **options: Any) -> CompletedScan:
    """As a user's scan is. A view with a table, with the way up that the table says."""
    eye, middle, up = view.eye, view.partial.mean(axis=0), "z"
    if view.table is not None:
        up = find_up(np.concatenate([view.partial, view.table]), eye).vector
    camera = None if eye is None else Camera.look_at(eye, middle)
    return completer.complete(view.partial, camera, up=up, **options)


def scored(view: View, points: Cloud) -> metrics.Scores:
    """How far points are from the truth, in half its longest side."""
    unit = 0.5 * view.size
    return metrics.score(points / unit, view.complete / unit)


def summary(scores: Sequence[metrics.Scores]) -> dict[str, float]:
    """What the table shows of the scores of all views."""
    cd_l2 = [one.cd_l2 for one in scores]
    return {
        "CD-L2 x1e4": 1e4 * float(np.mean(cd_l2)),
        "median": 1e4 * float(np.median(cd_l2)),
        "CD-L1 x1e3": 1e3 * float(np.mean([one.cd_l1 for one in scores])),
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
    flags.DEFINE_enum("dataset", "shapes", ("shapes", "roboarm"), "Its validation.")
    flags.DEFINE_integer("limit", None, "Views to use, evenly spaced.", lower_bound=1)
    flags.DEFINE_multi_enum("shift", list(SHIFTS), list(SHIFTS), "Shifts to apply.")
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Shifts, completes, scores, prints the table and writes the result."""
    prepare_output(FLAGS.output, ".json")
    completer = Completer.from_pretrained(located(FLAGS.weights))
    split = validation_split(FLAGS.dataset)
    views = views_of(FLAGS.dataset, split, FLAGS.limit)
    rows = {}
    for name in FLAGS.shift:
        scores = []
        for number, view in enumerate(tqdm(views, desc=name, mininterval=2.0)):
            shifted = SHIFTS[name](view, np.random.default_rng(number))
            clouds = shifted.partial, completed(completer, shifted).points
            scores.append([scored(shifted, cloud) for cloud in clouds])
        before, after = map(summary, zip(*scores, strict=True))
        rows[name] = {"views": len(views), "partial": before, "completed": after}
    result = {
        "commit": commit(),
        "data": f"{FLAGS.dataset}, {split}",
        "digest": digest_of(FLAGS.dataset, split),
        "weights": FLAGS.weights,
        "variables_sha256": sha256(completer.variables),
        "shifts": rows,
    }
    shown = {name: row["completed"] for name, row in rows.items()}
    print_and_write(result, table("shift", shown))


def run() -> None:
    """The entry point."""
    define_flags()
    launch("robustness", main)


if __name__ == "__main__":
    run()
