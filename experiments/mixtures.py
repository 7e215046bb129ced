"""What each part of a corpus does to completions under shift.

    experiments/train_mixtures.sh --workdir=DIR
    python -m experiments.mixtures --workdir=DIR --output=FILE.json

Of every set of validation data one table: what a user gets after trainings that differ
by one thing each, without adaptation. Changes are against the first. --trainings and
--sets compare others: any folders with weights.safetensors, and the results of
`experiments.evaluate` beside them. FOLDER:CLOUD takes another of their clouds than
`completed`, and --stepwise compares each with the one before.
"""

import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from absl import flags

from experiments.comparison import ABOVE, Row, comparison, comparison_markdown
from experiments.output import prepare_output
from experiments.scoring import print_and_write
from prism_jax.cli.launch import launch
from prism_jax.io.errors import InputError, choose
from prism_jax.training.run import commit
from prism_jax.weights import read_metadata, samples_seen

FLAGS = flags.FLAGS

MIXTURES = {
    "today": "shapes, whole, in one pose",
    "poses": "turned and tilted",
    "occluded": "and occluded, truncated, sparse",
    "open": "and open shapes",
    "models": "occluded, and people's models",
    "all": "all of it, and cells",
}
"""What `train_mixtures.sh` trains on, and what is said of it."""

SETS = ("shapes-novel", "objects-validation", "roboarm-validation", "shapes-validation")
"""What it scores on."""


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("workdir", None, "That of the trainings.", required=True)
    flags.DEFINE_string("output", None, "JSON file to write; Markdown goes beside it.")
    flags.DEFINE_list(
        "trainings", [*MIXTURES], "Folders in --workdir, compared with the first one."
    )
    flags.DEFINE_list("sets", [*SETS], "Names of the results in each folder.")
    flags.DEFINE_bool("stepwise", False, "Compare each with the one before instead.")


def main() -> None:
    """Reads the scores of the trainings that are there, and compares them."""
    prepare_output(FLAGS.output, ".json")
    workdir = pathlib.Path(FLAGS.workdir)
    sets = {
        name: compared(workdir, name, FLAGS.trainings, FLAGS.stepwise)
        for name in FLAGS.sets
    }
    result = {"commit": commit(), "sets": sets}
    print_and_write(result, mixtures_markdown(result))


def compared(
    workdir: pathlib.Path, name: str, trainings: Sequence[str], stepwise: bool = False
) -> dict[str, Any]:
    """The trainings side by side on one set. The partial is last, or the first step."""
    rows = {}
    for given in trainings:
        training, _, cloud = given.partition(":")
        path = workdir / training / f"{name}.json"
        if not path.exists():
            continue
        found = json.loads(path.read_text())
        seen = samples_seen(read_metadata(str(path.parent / "weights.safetensors")))
        cloud = choose("--trainings", cloud or "completed", found["clouds"])
        rows[_label(given)] = Row(found, cloud, samples=seen)
    base = _label(trainings[0])
    if base not in rows:
        remedy = "train and score it first (experiments/train_mixtures.sh)"
        path = workdir / trainings[0].partition(":")[0] / f"{name}.json"
        raise InputError(path, "is missing", remedy)
    first = rows[base]
    about = ("data", "split", "digest", "normalisation", "steps")
    known = {
        key: first.result[key]
        for key in about
        if key in first.result
        and all(row.result.get(key) == first.result[key] for row in rows.values())
    }
    partial = {"the partial": Row(first.result, "partial")}
    if stepwise:
        return comparison(partial | rows, ABOVE, **known)
    return comparison(rows | partial, base, **known)


def _label(given: str) -> str:
    """What a row of a folder, or of one of its clouds, is called."""
    return MIXTURES.get(given, given.replace(":", ", "))


def mixtures_markdown(result: Mapping[str, Any]) -> str:
    """The tables one after the other."""
    return "\n".join(comparison_markdown(table) for table in result["sets"].values())


def run() -> None:
    """The entry point."""
    define_flags()
    launch("mixtures", main)


if __name__ == "__main__":
    run()
