"""Scores weights on a split of a data set, with and without adaptation.

python -m experiments.evaluate --weights=small --split=test --output=FILE.json
python -m experiments.evaluate --weights=FILE --dataset=shapenet55 --data_dir=DIR \
    --protocol=published --output=FILE.json

The tables show the scores of every cloud and the change by adaptation, with intervals
over objects and over categories (kinds of shapes, robot arms), and the category with
the largest effect. Weights that use visibility (`model.uses_visibility`) get it where
the data set has it.
"""

import dataclasses
from typing import Any

from absl import flags

from experiments.output import prepare_output
from experiments.protocol import Protocol
from experiments.published import (
    OPTIONS,
    PUBLISHED,
    published_columns,
    published_markdown,
)
from experiments.run_folder import commit
from experiments.scoring import (
    define_scoring_flags,
    describe_data,
    make_protocol,
    open_split,
    print_and_write,
    prism_completer,
    run_evaluation,
)
from experiments.settings import changed
from experiments.weights import located
from prism_jax.adaptation.config import PrismConfig
from prism_jax.cli.launch import launch
from prism_jax.completion.weights import file_sha256, load_pretrained, read_metadata
from prism_jax.data.datasets import open_dataset
from prism_jax.data.source import Source
from prism_jax.evaluation.tables import markdown
from prism_jax.io.errors import InputError

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags; the split defaults to validation, or to test if published."""
    define_scoring_flags(split=None)
    flags.DEFINE_string("weights", "small", "Released weights, name or file.")
    flags.DEFINE_enum(
        "protocol",
        "standard",
        ("standard", "published"),
        "published: the published test, unit and metrics of the data set.",
    )
    flags.DEFINE_integer(
        "steps", None, "Adaptation steps. Default: the weights' own.", 0
    )
    flags.DEFINE_multi_string(
        "set",
        [],
        "Settings of adaptation or input to change, path.to.field=value, such as "
        "model.background=empty.",
    )


def main():
    """Scores the weights, prints the tables and writes them if asked."""
    prepare_output(FLAGS.output, ".json")
    config, variables = load_pretrained(located(FLAGS.weights))
    config = changed(config, FLAGS.set)
    if FLAGS.steps is not None:
        config = config.with_adapt(num_steps=FLAGS.steps)
    published = FLAGS.protocol == "published"
    split = FLAGS.split or ("test" if published else "validation")
    source = open_published(split) if published else open_split(split)
    protocol = make_protocol(config, published)
    protocol = dataclasses.replace(
        protocol, uses_visibility=config.model.uses_visibility
    )
    scores = run_evaluation(prism_completer(config, variables), source, protocol)
    result = {**about(config, protocol, split), **scores}
    table = markdown(result)
    if published:
        result["published"] = published_columns(result)
        table = f"{published_markdown(result)}\n{table}"
    print_and_write(result, table)


def open_published(split: str) -> Source:
    """The whole test split of a data set with a published protocol."""
    if FLAGS.limit is not None:
        fault = "the published protocol uses the whole test split"
        raise InputError("--limit", fault, "omit it")
    if FLAGS.dataset not in PUBLISHED or split != "test":
        fault = f"no published protocol for split {split!r} of {FLAGS.dataset}"
        remedy = f"use the test split of {', '.join(PUBLISHED)}"
        raise InputError("--protocol", fault, remedy)
    return open_dataset(FLAGS.dataset, split, FLAGS.data_dir, **OPTIONS)


def about(config: PrismConfig, protocol: Protocol, split: str) -> dict[str, Any]:
    """The part of the result that says what it was made from."""
    known = read_metadata(located(FLAGS.weights))
    return {
        **describe_data(split),
        "protocol": FLAGS.protocol,
        "normalisation": protocol.normalisation,
        "weights": FLAGS.weights,
        "weights_sha256": file_sha256(located(FLAGS.weights)),
        "seed": known.get("seed"),
        "weights_commit": known.get("commit"),
        "steps": config.adapt.num_steps,
        **({"set": " ".join(FLAGS.set)} if FLAGS.set else {}),
        "commit": commit(),
    }


def run():
    """The entry point."""
    define_flags()
    launch("evaluate", main)


if __name__ == "__main__":
    run()
