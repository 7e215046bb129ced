"""Measures how well scenes come apart: what they stand on, and thing by thing.

    python -m experiments.segmentation --scan=../shared/real/kinect/mosd_test24.pcd \
        --output=docs/tables/segmentation.json

Scenes of validation are split as `prism-complete` splits a scan whose sensor is at the
origin, in the sensor's own axes, without being told which way is up. A `--scan` is a
PCD of the same kind, with a field `label` that tells its things apart; what has most
points is what they stand on.
"""

import pathlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from absl import flags
from jaxtyping import Float, Int
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.scoring import print_and_write
from experiments.simulation.build_dataset import build_if_missing
from prism_jax.cli.launch import launch
from prism_jax.data.datasets import digest_of, open_dataset
from prism_jax.data.scenes import Scenes
from prism_jax.evaluation.bootstrap import mean_intervals
from prism_jax.evaluation.segmentation import MIN_POINTS, WELL, Agreement, agreement
from prism_jax.evaluation.tables import short
from prism_jax.io.errors import InputError
from prism_jax.io.pcd import read_pcd, read_pcd_field
from prism_jax.observation.scene import SUPPORT, split_scene
from prism_jax.observation.support import find_up
from prism_jax.training.run import commit

FLAGS = flags.FLAGS

PLACE = ("scenes", "validation")
TRAITS = ("table", "floor", "wall", "camera", "lidar")


class Scored(NamedTuple):
    """A scene that was taken apart: what stands for it in tables, and how it went."""

    name: str
    traits: tuple[str, ...]
    agreement: Agreement


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_integer("limit", None, "So many scenes, the first ones.", 1)
    flags.DEFINE_multi_string("scan", [], "Labelled PCD files, measured beside them.")
    flags.DEFINE_string("data_dir", None, "Folder of the set.")
    flags.DEFINE_string("output", None, "JSON file to write; Markdown goes beside it.")


def main() -> None:
    """Splits, measures, writes and prints the table."""
    prepare_output(FLAGS.output, ".json")
    scans = [labelled_scan(path) for path in FLAGS.scan]
    build_if_missing(*PLACE, FLAGS.data_dir)
    source = open_dataset(*PLACE, FLAGS.data_dir)
    assert isinstance(source, Scenes)
    count = min(FLAGS.limit or source.num_scenes, source.num_scenes)
    scenes = []
    for number in tqdm(range(count), desc="scenes", mininterval=2.0):
        scene = source.scene(number).in_sensor_axes()
        found = scored(scene.points, scene.labels)
        scenes.append(Scored(scene.name, scene.traits, found))
    names = [pathlib.Path(path).stem for path in FLAGS.scan]
    real = [
        Scored(name, (), scored(*scan)) for name, scan in zip(names, scans, strict=True)
    ]
    result = {
        "commit": commit(),
        "digest": digest_of(*PLACE, FLAGS.data_dir),
        "min_points": MIN_POINTS,
        "scenes": {name: measured(part) for name, part in parts_of(scenes)},
        "real": {one.name: measured([one]) for one in real},
        "by_scene": [told(one) for one in scenes],
    }
    print_and_write(result, segmentation_markdown(result))


def scored(
    points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, " N"]
) -> Agreement:
    """How what is found of points, seen from the origin, agrees with their labels."""
    eye = np.zeros(3)
    up = find_up(points, eye, np.eye(3)).vector
    return agreement(labels, split_scene(points, up, eye).object)


def labelled_scan(
    path: str,
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, " N"]]:
    """The finite points of a PCD, and whose they are by its field `label`."""
    points, label = read_pcd(path), read_pcd_field(path, "label")
    finite = np.isfinite(points).all(axis=1)
    _, kinds, counts = np.unique(label[finite], return_inverse=True, return_counts=True)
    if len(counts) < 2:
        remedy = "label what things stand on and each of them"
        raise InputError(path, "has fewer than two labels", remedy)
    order = np.argsort(-counts, kind="stable")
    number = np.empty(len(counts), int)
    number[order] = np.arange(len(counts)) + SUPPORT
    return points[finite], number[kinds]


def parts_of(scenes: list[Scored]) -> Iterable[tuple[str, list[Scored]]]:
    """All scenes, and those with each trait."""
    yield "all", scenes
    for trait in TRAITS:
        part = [one for one in scenes if trait in one.traits]
        if part:
            yield trait, part


def measured(scenes: list[Scored]) -> dict[str, Any]:
    """Means over things and over scenes, with intervals over scenes if there are
    several."""
    found = [one.agreement for one in scenes]
    group = np.repeat(np.arange(len(found)), [len(one.overlap) for one in found])
    overlap = np.concatenate([one.overlap for one in found])
    things = {
        "well": overlap > WELL,
        "overlap": overlap,
        "merged": np.concatenate([one.merged for one in found]),
        "split": np.concatenate([one.split for one in found]),
        "lost": np.concatenate([one.lost for one in found]),
    }
    whole = {
        "support_recall": np.array([one.support_recall for one in found]),
        "support_precision": np.array([one.support_precision for one in found]),
        "spurious": np.array([one.num_spurious for one in found]),
    }
    row: dict[str, Any] = {"scenes": len(found), "things": len(overlap)}
    for values, groups in (things, group), (whole, np.arange(len(found))):
        for name, column in values.items():
            kept = np.isfinite(column.astype(float))
            row[name] = _mean(column[kept].astype(float), groups[kept])
    return row


def _mean(
    values: Float[np.ndarray, " N"], groups: Int[np.ndarray, " N"]
) -> dict[str, Any]:
    """The mean of values, and its interval over groups."""
    if not len(values):
        return {"mean": None, "interval": None}
    groups = np.unique(groups, return_inverse=True)[1]
    if groups.max() == 0:
        return {"mean": float(values.mean()), "interval": None}
    low, high = mean_intervals(values[:, None], groups)
    return {"mean": float(values.mean()), "interval": [low[0], high[0]]}


def told(one: Scored) -> dict[str, Any]:
    """A scene's own numbers, to find those that went wrong."""
    found = one.agreement
    return {
        "scene": one.name,
        "traits": one.traits,
        "overlap": [round(float(overlap), 3) for overlap in found.overlap],
        "merged": int(found.merged.sum()),
        "split": int(found.split.sum()),
        "lost": int(found.lost.sum()),
        "spurious": found.num_spurious,
        "support_recall": round(found.support_recall, 4),
        "support_precision": round(found.support_precision, 4),
    }


def segmentation_markdown(result: Mapping[str, Any]) -> str:
    """A row for all scenes, for those with each trait, and for each scan."""
    lines = [
        f"commit {short(result['commit'] or 'unknown')}, data {result['digest']}. Of "
        f"things of more than {result['min_points']} points; 95 % intervals over "
        "scenes.\n",
        f"| scenes | number | things | {' | '.join(_COLUMNS)} |",
        f"| --- | --- | --- |{' --- |' * len(_COLUMNS)}",
    ]
    named = [*result["scenes"].items(), *result["real"].items()]
    for name, row in named:
        cells = [_cell(row[key], form) for key, form in _COLUMNS.values()]
        head = f"| {name} | {row['scenes']} | {row['things']} |"
        lines.append(f"{head} {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cell(value: Mapping[str, Any], form: str) -> str:
    if value["mean"] is None:
        return "-"
    text = format(value["mean"], form)
    if value["interval"] is None:
        return text
    low, high = (format(end, form).rstrip("%") for end in value["interval"])
    return f"{text} [{low}, {high}]"


_COLUMNS = {
    f"IoU above {WELL}": ("well", ".1%"),
    "mean IoU": ("overlap", ".2f"),
    "merged with another": ("merged", ".1%"),
    "split": ("split", ".1%"),
    "mostly lost": ("lost", ".1%"),
    "support recall": ("support_recall", ".1%"),
    "support precision": ("support_precision", ".1%"),
    "objects of nothing, a scene": ("spurious", ".2f"),
}


def run() -> None:
    """The entry point."""
    define_flags()
    launch("segmentation", main)


if __name__ == "__main__":
    run()
