"""Scores weights on a split of a data set, the procedural shapes unless told otherwise.

python -m experiments.evaluate --weights=small --split=test --output=FILE.json
"""

import dataclasses
import json
import pathlib

from absl import flags

from experiments.launch import launch, with_large_pages
from prism_jax.data.datasets import (
    DATASETS,
    build_if_missing,
    open_dataset,
)
from prism_jax.evaluation import evaluate, markdown
from prism_jax.io.atomic import write_bytes
from prism_jax.training.run import commit
from prism_jax.weights import load_pretrained

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "Released weights, by name or by file.")
    flags.DEFINE_enum("dataset", "shapes", DATASETS, "What to score on.")
    flags.DEFINE_string("data_dir", None, "Its folder; shapes and roboarm have one.")
    flags.DEFINE_string("split", "validation", "The data set's split.")
    flags.DEFINE_integer(
        "steps", None, "Adaptation steps, the weights' own if not given."
    )
    flags.DEFINE_integer("limit", None, "Score the first so many examples only.")
    flags.DEFINE_string("output", None, "JSON file to write; Markdown goes beside it.")


def main(argv):
    """Builds the split where it is missing, scores, writes and prints the table."""
    del argv
    config, variables = load_pretrained(FLAGS.weights)
    if FLAGS.steps is not None:
        config = dataclasses.replace(config, num_steps=FLAGS.steps)
    place = (FLAGS.dataset, FLAGS.split, FLAGS.data_dir)
    build_if_missing(*place)
    source = open_dataset(*place)
    about = {
        "weights": FLAGS.weights,
        "data": FLAGS.dataset,
        "split": FLAGS.split,
        "normalisation": "partial",
        "steps": config.num_steps,
        "commit": commit(),
    }
    result = {**about, **evaluate(config, variables, source, FLAGS.limit)}
    table = markdown(result)
    print(table)
    if FLAGS.output is not None:
        path = pathlib.Path(FLAGS.output)
        write_bytes(path, json.dumps(result, indent=1).encode())
        write_bytes(path.with_suffix(".md"), table.encode())


def run():
    """The entry point."""
    with_large_pages()
    define_flags()
    launch("evaluate", main)


if __name__ == "__main__":
    run()
