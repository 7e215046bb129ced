"""How far the label-free losses point where the error falls, frame by frame.

python -m experiments.gradients --weights=small --limit=200 --output=FILE.json
"""

from absl import flags

from experiments.loss_gradients import agreement
from experiments.scoring import (
    define_scoring_flags,
    deliver,
    make_protocol,
    named,
    open_split,
)
from experiments.weights import located
from prism_jax.cli.launch import launch, prepare_output
from prism_jax.evaluation import agreement_markdown
from prism_jax.weights import load_pretrained

FLAGS = flags.FLAGS


def main():
    """Prints the mean cosine of every loss, and the error after a step along it."""
    prepare_output(FLAGS.output, ".json")
    config, variables = load_pretrained(located(FLAGS.weights))
    source, protocol = open_split(FLAGS.split), make_protocol(config)
    sizes = (FLAGS.limit, FLAGS.batch_size)
    found = agreement(config, variables, source, protocol, *sizes)
    result = {**named(protocol), "weights": FLAGS.weights, **found}
    deliver(result, agreement_markdown(result))


def run():
    """The entry point."""
    define_scoring_flags(split="validation")
    flags.DEFINE_string("weights", "small", "Released weights, by name or by file.")
    launch("gradients", main)


if __name__ == "__main__":
    run()
