"""Table II: the effect of adaptation, by number of steps, and of meta-learning.

python -m experiments.table_2 --split=test --output=tables/table_2.json
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

from experiments.comparison import Row, comparison
from experiments.output import prepare_output
from experiments.scored_run import CompleteFn, Predictions
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
from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.cli.launch import launch
from prism_jax.models.variables import Variables, pop_encoders, put_encoders
from prism_jax.preprocessing.observation import framed_view

FLAGS = flags.FLAGS
PRETRAINED, META = "pretrained", "meta-trained"


def define_flags() -> None:
    """The flags of this launcher."""
    define_scoring_flags(split="test")
    flags.DEFINE_string("weights", "small-meta", "Meta-trained weights, name or file.")
    flags.DEFINE_string(
        "pretrained",
        "small-meta-pretrained",
        "Weights trained on as many samples without the method.",
    )
    flags.DEFINE_multi_integer(
        "steps", [1, 3, 5, 10], "Numbers of adaptation steps.", 1
    )


def main():
    """Scores both weights with each number of steps, and two variants of one."""
    prepare_output(FLAGS.output, ".json")
    both = {
        PRETRAINED: in_one_pose(FLAGS.pretrained),
        META: in_one_pose(FLAGS.weights),
    }
    own, variables = both[META]
    require_equal_sizes(
        {name: prism_size(config) for name, (config, _) in both.items()}
    )
    source = open_split(FLAGS.split)
    protocol = dataclasses.replace(make_protocol(own), with_measured=False)
    rows = {}
    for name, (config, weights) in both.items():
        for steps in FLAGS.steps:
            # All with the settings of the meta-trained: what differs is the weights,
            # its learned step sizes among them.
            changed = PrismConfig(config.model, own.adapt).with_adapt(num_steps=steps)
            found = run_evaluation(prism_completer(changed, weights), source, protocol)
            rows.setdefault(f"{name}, K = 0", Row(found, "network_unadapted"))
            rows[f"{name}, K = {steps}"] = Row(found)
    for label, complete in {
        "equal weights": prism_completer(own, equally_weighted(variables)),
        "online": online_completer(own, variables),
    }.items():
        found = run_evaluation(complete, source, protocol)
        rows[f"{META}, K = {own.adapt.num_steps}, {label}"] = Row(found)
    about = describe_run(protocol) | {"weights": FLAGS.weights}
    print_and_write(comparison(rows, f"{PRETRAINED}, K = 0", **about))


def equally_weighted(variables: Variables) -> Variables:
    """The variables with the weights of Eq. 11 as they are before training."""
    weighting = variables["weighting"]
    # Of a branch that does not count it is minus infinity, before and after.
    logits = jnp.where(jnp.isneginf(weighting["logits"]), -jnp.inf, 0.0)
    return {**variables, "weighting": {**weighting, "logits": logits}}


def online_completer(config: PrismConfig, variables: Variables) -> CompleteFn:
    """Adapts to one frame after the other, each from the encoders of the one before."""
    adapt = make_adapt(config)
    encoders, rest = pop_encoders(variables)

    @jax.jit
    def one(encoders: Variables, partial: jax.Array, eye: jax.Array):
        camera = framed_view(partial, eye)
        done = adapt(put_encoders(encoders, rest), partial, camera)
        return done.encoders, (done.points, done.before, done.accepted)

    def complete(partials: np.ndarray, eyes: np.ndarray) -> Predictions:
        nonlocal encoders
        found = []
        for partial, eye in zip(partials, eyes, strict=True):
            encoders, predicted = one(encoders, partial, eye)
            found.append(jax.device_get(predicted))
        return Predictions(*(np.stack(column) for column in zip(*found, strict=True)))

    return complete


def run():
    """The entry point."""
    define_flags()
    launch("table_2", main)


if __name__ == "__main__":
    run()
