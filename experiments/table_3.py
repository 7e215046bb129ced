"""Table III: the effect of each auxiliary branch, on robots unseen in training.

python -m experiments.table_3 --output=tables/table_3.json
"""

import dataclasses

from absl import flags

from experiments.comparison import Row, comparison
from experiments.output import prepare_output
from experiments.scoring import (
    define_scoring_flags,
    describe_run,
    in_one_pose,
    make_protocol,
    open_split,
    print_and_write,
    prism_completer,
    prism_size,
    require_equal_sizes,
    run_evaluation,
)
from prism_jax.cli.launch import launch
from prism_jax.io.errors import InputError

FLAGS = flags.FLAGS
NONE = "none"
VARIANTS = {
    NONE: "small-meta-pretrained",
    "align": "small-meta-align",
    "align + normal": "small-meta-align-normal",
    "align + denoise": "small-meta-align-denoise",
    "all": "small-meta",
}
"""Weights meta-trained with some of the branches; ``none`` saw as many samples without
the method."""


def define_flags() -> None:
    """The flags of this launcher."""
    define_scoring_flags(dataset="roboarm", split="test")
    flags.DEFINE_multi_string(
        "weights",
        [],
        "Weights for a row, LABEL=NAME|FILE. Labels: "
        f"{', '.join(VARIANTS)}, or new ones.",
    )


def main():
    """Scores every variant, adapted with its own settings, on the same frames."""
    prepare_output(FLAGS.output, ".json")
    variants = dict(VARIANTS)
    for change in FLAGS.weights:
        label, equals, weights = change.partition("=")
        if not equals:
            raise InputError(change, "no label", "write LABEL=NAME|FILE")
        variants[label] = weights
    loaded = {label: in_one_pose(n) for label, n in variants.items()}
    require_equal_sizes(
        {label: prism_size(config) for label, (config, _) in loaded.items()}
    )
    source = open_split(FLAGS.split)
    protocol = make_protocol(loaded[NONE][0])
    rows = {}
    for label, (config, variables) in loaded.items():
        if label == NONE:
            config = config.with_adapt(num_steps=0)
        measured = dataclasses.replace(protocol, with_measured=label == NONE)
        found = run_evaluation(prism_completer(config, variables), source, measured)
        if label == NONE:
            rows["partial"] = Row(found, "partial")
        else:
            rows[f"{label}, not adapted"] = Row(found, "network_unadapted")
        rows[label] = Row(found)
    print_and_write(comparison(rows, NONE, **describe_run(protocol)))


def run():
    """The entry point."""
    define_flags()
    launch("table_3", main)


if __name__ == "__main__":
    run()
