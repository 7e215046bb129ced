"""What each part of a corpus does to completions under shift.

    python -m experiments.mixtures --workdir=DIR --output=FILE.json

Of every set of validation data one table: what a user gets after trainings that differ
by one thing each, without adaptation. Changes are against the first. --trainings and
--sets compare others: any folders with weights.safetensors, and the results of
`experiments.evaluate` beside them. FOLDER:CLOUD takes another of their clouds than
`completed`, and --stepwise compares each with the one before. A last table tells CD-L1
over all sets: which weights are best by it is what shares and mixtures are chosen by.
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
from prism_jax.evaluation.paired import shared_difference
from prism_jax.evaluation.tables import percent, table_lines
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
"""What was trained on, and what is said of it."""

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
    rows = {name: rows_of(workdir, name, FLAGS.trainings) for name in FLAGS.sets}
    base = ABOVE if FLAGS.stepwise else _label(FLAGS.trainings[0])
    result = {
        "commit": commit(),
        "sets": {name: compared(found, base) for name, found in rows.items()},
    }
    if len(rows) > 1:
        result["together"] = together(list(rows.values()), base)
    print_and_write(result, mixtures_markdown(result))


def rows_of(
    workdir: pathlib.Path, name: str, trainings: Sequence[str]
) -> dict[str, Row]:
    """The scores on one set of the trainings that are there; the first has to be."""
    rows = {}
    for given in trainings:
        training, _, cloud = given.partition(":")
        path = workdir / training / f"{name}.json"
        if not path.exists():
            if given == trainings[0]:
                remedy = "train and score it first"
                raise InputError(path, "is missing", remedy)
            continue
        found = json.loads(path.read_text())
        seen = samples_seen(read_metadata(str(path.parent / "weights.safetensors")))
        cloud = choose("--trainings", cloud or "completed", found["clouds"])
        rows[_label(given)] = Row(found, cloud, samples=seen)
    return rows


def compared(rows: Mapping[str, Row], base: str) -> dict[str, Any]:
    """The trainings side by side on one set. The partial is last, or the first step."""
    first = next(iter(rows.values()))
    about = ("data", "split", "digest", "normalisation", "steps", "set")
    known = {
        key: first.result[key]
        for key in about
        if key in first.result
        and all(row.result.get(key) == first.result[key] for row in rows.values())
    }
    partial = {"the partial": Row(first.result, "partial")}
    ordered = {**partial, **rows} if base == ABOVE else {**rows, **partial}
    return comparison(ordered, base, **known)


def together(sets: Sequence[Mapping[str, Row]], base: str) -> dict[str, Any]:
    """CD-L1 over all sets of the trainings that each has (`shared_difference`)."""
    labels = [label for label in sets[0] if all(label in rows for rows in sets)]
    before = [labels[0], *labels] if base == ABOVE else [base] * len(labels)
    rows = {}
    for label, other in zip(labels, before, strict=False):
        pairs = [(rows[other].result, rows[label].result) for rows in sets]
        clouds = (sets[0][other].cloud, sets[0][label].cloud)
        rows[label] = shared_difference(pairs, "cd_l1", clouds)
    return {"against": base, "rows": rows}


def _label(given: str) -> str:
    """What a row of a folder, or of one of its clouds, is called."""
    return MIXTURES.get(given, given.replace(":", ", "))


def mixtures_markdown(result: Mapping[str, Any]) -> str:
    """The tables one after the other, and what they say together."""
    tables = [comparison_markdown(table) for table in result["sets"].values()]
    if "together" in result:
        tables.append(together_markdown(result["together"], len(tables)))
    return "\n".join(tables)


def together_markdown(found: Mapping[str, Any], sets: int) -> str:
    """What decides between trainings: CD-L1 over all sets."""
    against = found["against"]
    head = ["", "CD-L1 x1e3", f"CD-L1 against {against}"]
    lines = []
    for number, (label, row) in enumerate(found["rows"].items()):
        same = label == against or (against == ABOVE and number == 0)
        change = "" if same else percent(row["change"], row["interval"])
        lines.append([label, f"{1e3 * row['mean']:.4g}", change])
    title = f"Together: the geometric mean over examples, then over the {sets} sets.\n"
    return "\n".join([title, *table_lines(head, lines), ""])


def run() -> None:
    """The entry point."""
    define_flags()
    launch("mixtures", main)


if __name__ == "__main__":
    run()
