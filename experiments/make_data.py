"""Builds a generated data set: python -m experiments.make_data --dataset=shapes"""

from absl import app, flags

from prism_jax.cli.launch import launch
from prism_jax.data.corpus import SPLITS
from prism_jax.data.datasets import GENERATED, build_dataset
from prism_jax.simulation.roboarm.models import own_arm

FLAGS = flags.FLAGS

_CHANGES = {
    "shapes": ("num_shapes", "num_views", "partial", "seed"),
    "roboarm": ("num_sequences", "num_frames", "seed", "urdf"),
}


def define_flags() -> None:
    """The flags of this launcher; what is not given is the set's own."""
    flags.DEFINE_enum("dataset", "shapes", GENERATED, "What to build.")
    flags.DEFINE_enum("split", "train", SPLITS, "Split to build.")
    flags.DEFINE_string("output_dir", None, "By default the user's cache folder.")
    flags.DEFINE_integer("num_workers", None, "By default one for every core.", 0)
    flags.DEFINE_integer("seed", None, "Of the whole set.")
    flags.DEFINE_integer("num_shapes", None, "shapes: how many.")
    flags.DEFINE_integer("num_views", None, "shapes: partial clouds of each.")
    flags.DEFINE_string("partial", None, "shapes: kind of the partial clouds.")
    flags.DEFINE_integer("num_sequences", None, "roboarm: how many.")
    flags.DEFINE_integer("num_frames", None, "roboarm: frames of each sequence.")
    flags.DEFINE_multi_string("urdf", None, "roboarm: URDF files of your own robots.")


def main():
    """Builds what is missing of the split and prints its folder."""
    known = {name for names in _CHANGES.values() for name in names}
    given = {name: FLAGS[name].value for name in sorted(known)}
    given = {name: value for name, value in given.items() if value is not None}
    for name in given.keys() - _CHANGES[FLAGS.dataset]:
        raise app.UsageError(f"--{name} does not belong to --dataset={FLAGS.dataset}")
    if "urdf" in given:
        given["arms"] = [own_arm(path) for path in given.pop("urdf")]
    print(
        build_dataset(
            FLAGS.dataset, FLAGS.split, FLAGS.output_dir, FLAGS.num_workers, **given
        )
    )


def run():
    """The entry point."""
    define_flags()
    launch("make_data", main)


if __name__ == "__main__":
    run()
