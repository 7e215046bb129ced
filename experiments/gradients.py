"""How well the gradients of label-free losses agree with that of the error.

python -m experiments.gradients --weights=small --limit=200 --output=FILE.json
"""

from absl import flags

from experiments.loss_gradients import agreement_markdown, gradient_agreement
from experiments.output import prepare_output
from experiments.scoring import (
    define_scoring_flags,
    describe_run,
    make_protocol,
    open_split,
    print_and_write,
)
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.weights import load_pretrained

FLAGS = flags.FLAGS


def main():
    """Prints each loss's mean cosine with the error, and what a step along it does."""
    prepare_output(FLAGS.output, ".json")
    config, variables = load_pretrained(located(FLAGS.weights))
    source, protocol = open_split(FLAGS.split), make_protocol(config)
    sizes = (FLAGS.limit, FLAGS.batch_size)
    found = gradient_agreement(config, variables, source, protocol, *sizes)
    result = {**describe_run(protocol), "weights": FLAGS.weights, **found}
    print_and_write(result, agreement_markdown(result))


def run():
    """The entry point."""
    define_scoring_flags(split="validation")
    flags.DEFINE_string("weights", "small", "Released weights, by name or by file.")
    launch("gradients", main)


if __name__ == "__main__":
    run()
