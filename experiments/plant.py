"""What training on unlabelled frames of a cell does to other frames of such cells.

python -m experiments.plant --weights=small --split=validation --output=FILE.json
python -m experiments.plant --dataset=recordings --data_dir=DIR --split=all

Of every robot, or category, every other sequence is scored, and the network is trained
on frames of the rest as `experiments.adapt_plant` trains it, without their truth. Both
are scored without adaptation to each frame. What does not pass the check on held-out
frames, and would not be written, is scored all the same, and said to have failed.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from absl import flags

from experiments.adapt_plant import define_plant_flags, in_words
from experiments.comparison import Row, comparison, comparison_markdown
from experiments.output import prepare_output
from experiments.plants.check import verdict
from experiments.plants.frames import Unlabelled, evenly, other_sequences
from experiments.plants.training import PlantConfig, adapt
from experiments.scoring import (
    define_scoring_flags,
    describe_run,
    make_protocol,
    open_split,
    print_and_write,
    run_evaluation,
)
from experiments.settings import changed
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.data.holdout import Subset
from prism_jax.data.source import Source
from prism_jax.evaluation.paired import MEASURES
from prism_jax.evaluation.run import prism_completer
from prism_jax.evaluation.tables import LABELS, change_cells, table_lines
from prism_jax.io.errors import InputError
from prism_jax.weights import load_pretrained

FLAGS = flags.FLAGS

CLOUDS = ("network", "completed")
ADAPTED = "adapted"


def define_flags() -> None:
    """The flags; what is to be chosen is chosen on the validation split."""
    define_scoring_flags("validation", "roboarm")
    define_plant_flags()


def main():
    """Adapts to some sequences, scores the others, prints and writes the tables."""
    prepare_output(FLAGS.output, ".json")
    config, variables = load_pretrained(located(FLAGS.weights))
    settings = changed(PlantConfig(), FLAGS.set)
    source = open_split(FLAGS.split)
    rows, scored = other_sequences(source, categories_of(source))
    if not len(scored):
        remedy = "use a set with two sequences or more of one robot"
        raise InputError(FLAGS.dataset, "has no other sequence to score", remedy)
    frames = evenly(Unlabelled(Subset(source, rows)), FLAGS.frames)
    minutes = None if FLAGS.steps is not None else FLAGS.minutes
    adapted = adapt(
        config, variables, frames, settings, FLAGS.seed, FLAGS.steps, minutes
    )
    better, told = verdict(adapted.before, adapted.after)
    print(in_words(adapted.steps, adapted.num_frames, told))
    protocol = dataclasses.replace(make_protocol(config), with_emd=False)
    config = config.with_adapt(num_steps=0)
    others = Subset(source, scored)
    results = {
        label: run_evaluation(prism_completer(config, each), others, protocol)
        for label, each in ((FLAGS.weights, variables), (ADAPTED, adapted.variables))
    }
    about = {
        **describe_run(protocol),
        "weights": FLAGS.weights,
        "seed": FLAGS.seed,
        "steps": adapted.steps,
        **({"set": " ".join(FLAGS.set)} if FLAGS.set else {}),
    }
    tables = {
        cloud: comparison(
            {label: Row(result, cloud) for label, result in results.items()},
            FLAGS.weights,
            **about,
        )
        for cloud in CLOUDS
    }
    result = {
        "frames": adapted.num_frames,
        "sequences": adapted.num_sequences,
        "settings": dataclasses.asdict(settings),
        "passed": better,
        "check": told,
        "clouds": tables,
    }
    print_and_write(result, plant_markdown(result))


def categories_of(source: Source) -> list[str]:
    """Of each item, read once for each object."""
    objects, first = np.unique(source.objects, return_index=True)
    names = {
        number: source[int(row)].category
        for number, row in zip(objects, first, strict=True)
    }
    return [names[number] for number in source.objects]


def plant_markdown(result: Mapping[str, Any]) -> str:
    """What was done, the scores of both clouds, and every measure's change."""
    first = next(iter(result["clouds"].values()))
    passed = (
        "It passed." if result["passed"] else "It failed: nothing would be written."
    )
    words = in_words(first["steps"], result["frames"], result["check"])
    parts = [f"{words} {passed}\n"]
    changes = {}
    for cloud, table in result["clouds"].items():
        parts += [f"{cloud}:\n", comparison_markdown(table)]
        found = table["rows"][ADAPTED]["change"]
        changes |= {
            f"{cloud}, {LABELS[name]}": found[name]
            for name in MEASURES
            if name in found
        }
    heads, cells = change_cells(changes, f"against {first['against']}")
    rows = [[label, *row] for label, row in zip(changes, cells, strict=True)]
    return "\n".join([*parts, *table_lines(["", *heads], rows), ""])


def run():
    """The entry point."""
    define_flags()
    launch("plant", main)


if __name__ == "__main__":
    run()
