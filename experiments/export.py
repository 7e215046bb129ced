"""Exports completion by released weights, with or without adaptation, to one file.

python -m experiments.export --weights=small --batch_size=1 --output=adapt.jaxexport

experiments/run_exported.py runs it, and needs only JAX and the file.
"""

from absl import flags

from experiments.output import prepare_output
from experiments.weights import located
from prism_jax.cli.launch import launch
from prism_jax.completion.export import PLATFORMS, export_adapt
from prism_jax.completion.weights import load_pretrained
from prism_jax.io.atomic import write_bytes

FLAGS = flags.FLAGS


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


def run():
    """The entry point."""
    define_flags()
    launch("export", main)


if __name__ == "__main__":
    run()
