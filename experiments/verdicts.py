"""What an accepted adaptation lowers, and what it does not, term by term.

python -m experiments.verdicts --weights=small --split=test --output=FILE.json
"""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from absl import flags

from experiments.output import prepare_output
from experiments.scoring import (
    define_scoring_flags,
    describe_run,
    make_protocol,
    open_split,
    print_and_write,
)
from experiments.weights import located
from prism_jax.adaptation.objective import COMMON, Losses
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.cli.launch import launch
from prism_jax.data.pipeline import with_partial
from prism_jax.evaluation.protocol import observed, side_by_side
from prism_jax.geometry.workspace import Workspace
from prism_jax.observation.observation import observe
from prism_jax.weights import load_pretrained

FLAGS = flags.FLAGS
TERMS = {
    "objective": "the objective, Eq. 13",
    "depth_consistency": "depth consistency, Eq. 4",
    "normal": "normals, Eq. 5",
    "denoise": "denoising, Eq. 6",
    "align": "alignment, Eq. 9",
}


def main() -> None:
    """Adapts to every frame, and counts where each term rose."""
    prepare_output(FLAGS.output, ".json")
    config, variables = load_pretrained(located(FLAGS.weights))
    source, protocol = open_split(FLAGS.split), make_protocol(config)
    adapt = make_adapt(config)

    @jax.jit
    @jax.vmap
    def verdict(partial: jax.Array, eye: jax.Array) -> tuple[jax.Array, Losses]:
        done = adapt(variables, partial, observe(partial, eye, Workspace.unit()).camera)
        return done.accepted, done.losses

    count = min(len(source), FLAGS.limit or len(source))
    accepted, rose = [], []
    for start in range(0, count, FLAGS.batch_size):
        # The last batch is filled with the first examples, so that one size compiles.
        rows = np.arange(start, start + FLAGS.batch_size) % count
        seen = [observed(with_partial(source[int(row)]), protocol) for row in rows]
        verdicts, losses = verdict(*side_by_side(seen))
        of_batch = min(FLAGS.batch_size, count - start)
        accepted += np.asarray(verdicts)[:of_batch].tolist()
        terms = [getattr(losses, name) for name in COMMON]
        after_minus_before = np.stack([term[:, -1] - term[:, 0] for term in terms], 1)
        rose += (after_minus_before > 0)[:of_batch].tolist()
    of_accepted = np.array(rose)[np.array(accepted)]
    result = {
        **describe_run(protocol),
        "weights": FLAGS.weights,
        "num_examples": count,
        "accepted": float(np.mean(accepted)),
        "rose": dict(zip(COMMON, of_accepted.mean(0).tolist(), strict=True)),
    }
    print_and_write(result, verdicts_markdown(result))


def verdicts_markdown(result: Mapping[str, Any]) -> str:
    """In how many of the accepted frames each term rose."""
    lines = [
        f"data {result['data']}, split {result['split']}, weights {result['weights']}, "
        f"{result['num_examples']} examples, adaptation accepted for "
        f"{100 * result['accepted']:.0f} %.\n",
        "| term | accepted frames in which it rose |",
        "| --- | --- |",
    ]
    for name, label in TERMS.items():
        lines.append(f"| {label} | {100 * result['rose'][name]:.0f} % |")
    return "\n".join(lines) + "\n"


def run() -> None:
    """The entry point."""
    define_scoring_flags(split="test")
    flags.DEFINE_string("weights", "small", "Released weights, by name or by file.")
    launch("verdicts", main)


if __name__ == "__main__":
    run()
