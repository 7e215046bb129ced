"""Scores weights on a split of a data set, the procedural shapes unless told otherwise.

python -m experiments.evaluate --weights=small --split=test --output=FILE.json
python -m experiments.evaluate --weights=FILE --dataset=shapenet55 --data_dir=DIR \
    --protocol=published --output=FILE.json
"""

import dataclasses
import json
import pathlib
from typing import Any

from absl import flags

from experiments.launch import launch, with_large_pages
from prism_jax.adaptation.config import AdaptConfig
from prism_jax.data.datasets import (
    DATASETS,
    build_if_missing,
    open_dataset,
)
from prism_jax.data.source import Source
from prism_jax.evaluation import (
    NORMALISATIONS,
    PUBLISHED,
    Protocol,
    evaluate,
    markdown,
    prism_completer,
    published_columns,
    published_markdown,
    published_options,
)
from prism_jax.io.atomic import make_output_dir, write_bytes
from prism_jax.io.errors import InputError
from prism_jax.training.run import commit
from prism_jax.weights import load_pretrained, read_metadata

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "Released weights, by name or by file.")
    flags.DEFINE_enum("dataset", "shapes", DATASETS, "What to score on.")
    flags.DEFINE_string("data_dir", None, "Its folder; shapes and roboarm have one.")
    flags.DEFINE_string(
        "split", None, "The data set's split: validation, or test if published."
    )
    flags.DEFINE_enum(
        "protocol",
        "standard",
        ("standard", "published"),
        "published: the data set's own test, unit and columns.",
    )
    flags.DEFINE_enum(
        "normalisation",
        None,
        NORMALISATIONS,
        "What frames the network's input: the partial cloud, the complete one as in "
        "the paper, or nothing; partial, or own if published.",
    )
    flags.DEFINE_integer(
        "steps", None, "Adaptation steps, the weights' own if not given.", 0
    )
    flags.DEFINE_integer("limit", None, "Score the first so many examples only.", 1)
    flags.DEFINE_integer("batch_size", 20, "Examples completed at once.", 1)
    flags.DEFINE_string("output", None, "JSON file to write; Markdown goes beside it.")


def main(argv):
    """Builds the split where it is missing, scores, writes and prints the table."""
    del argv
    if FLAGS.output is not None:
        make_output_dir(pathlib.Path(FLAGS.output).parent)
    config, variables = load_pretrained(FLAGS.weights)
    if FLAGS.steps is not None:
        config = dataclasses.replace(config, num_steps=FLAGS.steps)
    published = FLAGS.protocol == "published"
    split = FLAGS.split or ("test" if published else "validation")
    source = open_source(split, published)
    protocol = make_protocol(config, published)
    scores = evaluate(
        prism_completer(config, variables),
        source,
        protocol,
        FLAGS.limit,
        FLAGS.batch_size,
    )
    result = {**about(config, protocol, split), **scores}
    table = markdown(result)
    if published:
        result["published"] = published_columns(FLAGS.dataset, result)
        table = f"{published_markdown(FLAGS.dataset, result)}\n{table}"
    print(table)
    if FLAGS.output is not None:
        path = pathlib.Path(FLAGS.output)
        write_bytes(path, json.dumps(result, indent=1).encode())
        write_bytes(path.with_suffix(".md"), table.encode())


def open_source(split: str, published: bool) -> Source:
    """The split, built where it is missing; of a published test, all of it."""
    place = (FLAGS.dataset, split, FLAGS.data_dir)
    if not published:
        build_if_missing(*place)
        return open_dataset(*place)
    if FLAGS.dataset not in PUBLISHED or split != "test":
        fault = f"no published protocol of {FLAGS.dataset}'s split {split!r}"
        remedy = f"use the test split of {', '.join(PUBLISHED)}"
        raise InputError("--protocol", fault, remedy)
    return open_dataset(*place, **published_options(FLAGS.dataset))


def make_protocol(config: AdaptConfig, published: bool) -> Protocol:
    """What the flags say of frames and units; a published test needs no EMD."""
    default = "own" if published else "partial"
    return Protocol(
        config.model.backbone.num_points,
        config.model.margin,
        FLAGS.normalisation or default,
        unit="own" if published else "complete",
        with_emd=not published,
    )


def about(config: AdaptConfig, protocol: Protocol, split: str) -> dict[str, Any]:
    """What names the result."""
    known = read_metadata(FLAGS.weights)
    return {
        "data": FLAGS.dataset,
        "split": split,
        "protocol": FLAGS.protocol,
        "normalisation": protocol.normalisation,
        "weights": FLAGS.weights,
        "seed": known.get("seed"),
        "weights_commit": known.get("commit"),
        "steps": config.num_steps,
        "commit": commit(),
    }


def run():
    """The entry point."""
    with_large_pages()
    define_flags()
    launch("evaluate", main)


if __name__ == "__main__":
    run()
