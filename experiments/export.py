"""Exports completion by released weights, with or without adaptation, to one file.

python -m experiments.export --weights=small --batch_size=1 --output=adapt.jaxexport

experiments/run_exported.py runs it, and needs only JAX and the file.
"""

from collections.abc import Sequence

import jax
import jax.export
import jax.numpy as jnp
from absl import flags
from jaxtyping import Array, Float

from experiments.output import prepare_output
from experiments.weights import located
from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.test_time import make_adapt
from prism_jax.cli.launch import launch
from prism_jax.completion.weights import load_pretrained
from prism_jax.io.atomic import write_bytes
from prism_jax.models.variables import Variables
from prism_jax.preprocessing.observation import observe

FLAGS = flags.FLAGS
PLATFORMS = ("cpu", "cuda")


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("weights", "small", "Released weights, name or file.")
    flags.DEFINE_integer("batch_size", 1, "Frames per call.", lower_bound=1)
    flags.DEFINE_integer(
        "steps", 0, "Steps of adaptation; 0 for none, as prism-complete.", lower_bound=0
    )
    flags.DEFINE_list("platforms", list(PLATFORMS), "Target platforms.")
    flags.DEFINE_string("output", "adapt.jaxexport", "File to write.")


def main():
    """Traces, lowers for every platform, writes."""
    prepare_output(FLAGS.output, ".jaxexport")
    config, variables = load_pretrained(located(FLAGS.weights))
    config = config.with_adapt(num_steps=FLAGS.steps)
    data = export_adapt(config, variables, FLAGS.batch_size, FLAGS.platforms)
    write_bytes(FLAGS.output, data)
    count = config.model.backbone.num_points
    print(f"written {FLAGS.output}, {len(data) / 1e6:.1f} MB")
    print(f"inputs: scans ({FLAGS.batch_size}, {count}, 3) and sensors' positions")


def export_adapt(
    config: PrismConfig,
    variables: Variables,
    batch_size: int = 1,
    platforms: Sequence[str] = PLATFORMS,
) -> bytes:
    """Completion, after `config.adapt.num_steps` of adaptation, weights included, as
    portable StableHLO (`jax.export`).

    `jax.export.deserialize` gives it back: its ``call`` takes scans ``(B, N, 3)`` of
    exactly ``config.model.backbone.num_points`` points, and the sensors' positions
    ``(B, 3)``, not finite where unknown, float32, in any unit of length and any upright
    frame (z up), and returns

    - ``points`` ``(B, M, 3)``, the network's completion in that unit and frame;
    - ``accepted`` ``(B,)``, whether the adapted completion is the one returned;
    - ``objective`` ``(B, K + 1)``, L_TTA of Eq. 13 before each step and after the last,
      if there are steps;
    - ``left_out`` ``(B,)``, how many points lay so far from all others that copies of
      another took their places.

    The workspace is taken from each scan. Precision is float32's: move a scan that is
    far from its frame's origin there first.
    """
    adapt = make_adapt(config)

    def complete(scan: Float[Array, "N 3"], sensor: Float[Array, "3"]):
        seen = observe(scan, sensor, config.model).filled()
        completion = adapt(variables, jnp.asarray(seen.partial), seen.camera)
        steps = completion.losses
        return {
            "points": seen.workspace.from_unit(completion.points),
            "accepted": completion.accepted,
            "left_out": jnp.sum(~seen.inside),
            **({} if steps is None else {"objective": steps.objective}),
        }

    num_points = config.model.backbone.num_points
    scans = jax.ShapeDtypeStruct((batch_size, num_points, 3), jnp.float32)
    sensors = jax.ShapeDtypeStruct((batch_size, 3), jnp.float32)
    export = jax.export.export(jax.jit(jax.vmap(complete)), platforms=platforms)
    return bytes(export(scans, sensors).serialize())


def run():
    """The entry point."""
    define_flags()
    launch("export", main)


if __name__ == "__main__":
    run()
