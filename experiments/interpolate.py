"""Interpolates between the initial and the final weights of a training.

python -m experiments.interpolate --start=small --end=FILE --share=0.5 --output=FILE

Fine-tuning on another data set improves results there and degrades them on the old one.
Weights halfway between the two, on the straight line, keep much of both (WiSE-FT,
Wortsman et al., 2022). Choose the share on validation data. Parts that only the final
weights have are taken from there, with a last layer that is scaled up from zero.
"""

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

from experiments.output import prepare_output
from experiments.run_folder import commit
from experiments.training import beginning, known_of, overlaid
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.weights import load_pretrained, save_weights, sha256
from prism_jax.io.errors import InputError
from prism_jax.models.variables import Variables

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("start", None, "Initial weights.", required=True)
    flags.DEFINE_string("end", None, "Final weights.", required=True)
    flags.DEFINE_float(
        "share", 0.5, "Position between start (0) and end (1).", 0.0, 1.0
    )
    flags.DEFINE_string("output", None, "File to write.", required=True)


def main() -> None:
    """Writes the weights in between."""
    prepare_output(FLAGS.output, ".safetensors")
    config, end = load_pretrained(located(FLAGS.end))
    about = known_of(FLAGS.end)
    fresh = beginning(FLAGS.start, config.model, FLAGS.end, about.get("seed"))
    if jax.tree.structure(fresh) != jax.tree.structure(end):
        fault = f"cannot come from a training that started at {FLAGS.start}"
        raise InputError(FLAGS.end, fault, "give the weights it started from")
    _, given = load_pretrained(located(FLAGS.start))
    start = overlaid(silent(end, fresh), given)
    # Of the rest of its metadata, what was fitted to the end is not true here.
    about["interpolated"] = {
        "start": sha256(start),
        "end": sha256(end),
        "share": FLAGS.share,
        "commit": commit(),
    }
    save_weights(FLAGS.output, config, between(start, end, FLAGS.share), about)
    print(f"written {FLAGS.output}")


def silent(end: Variables, fresh: Variables) -> Variables:
    """The end, with its layers zero that are zero in the fresh tree."""
    if "kernel" in fresh and not np.any(fresh["kernel"]):
        return jax.tree.map(jnp.zeros_like, end)
    return {
        name: silent(part, fresh[name]) if isinstance(part, dict) else part
        for name, part in end.items()
    }


def between(start: Variables, end: Variables, share: float) -> Variables:
    """Each number so far from the first to the second; both trees have one form."""
    return jax.tree.map(lambda a, b: (1.0 - share) * a + share * b, start, end)


def run() -> None:
    """The entry point."""
    define_flags()
    launch("interpolate", main)


if __name__ == "__main__":
    run()
