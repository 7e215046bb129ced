"""Builds a data set: python -m experiments.make_data --dataset=shapes --split=test

python -m experiments.make_data --dataset=meshes --mesh_dir=FOLDER --split=train \
    --output_dir=DIR
"""

from absl import app, flags

from experiments.simulation.build_dataset import BUILDERS, build_dataset, settings_of
from prism_jax.cli.launch import launch
from prism_jax.data.datasets import DATASETS

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher; what is not given is the set's own."""
    flags.DEFINE_enum("dataset", "shapes", BUILDERS, "What to build.")
    flags.DEFINE_enum("split", "train", DATASETS["shapes"].splits, "Split to build.")
    flags.DEFINE_string("output_dir", None, "By default the user's cache folder.")
    flags.DEFINE_integer("num_workers", None, "By default one for every core.", 0)
    flags.DEFINE_integer("seed", None, "Of the whole set.")
    flags.DEFINE_integer("num_shapes", None, "shapes, open: how many.")
    flags.DEFINE_integer("num_views", None, "Of each shape or model: partial clouds.")
    flags.DEFINE_string(
        "partial", None, "Of shapes and models: kind of partial clouds."
    )
    flags.DEFINE_integer("num_scenes", None, "scenes: how many.")
    flags.DEFINE_list(
        "sources", None, "scenes: of shapes, open, objects; commas between."
    )
    flags.DEFINE_integer("num_sequences", None, "roboarm: how many.")
    flags.DEFINE_integer("num_cells", None, "cells: how many.")
    flags.DEFINE_integer("num_frames", None, "roboarm, cells: frames of each one.")
    flags.DEFINE_multi_string("urdf", None, "roboarm: URDF files of your own robots.")
    flags.DEFINE_string("catalogue_dir", None, "objects, scenes: by default Debian's.")
    flags.DEFINE_string("mesh_dir", None, "meshes: the folder that holds them.")


def main():
    """Builds what is missing of the split and prints its folder."""
    known = sorted({setting for name in BUILDERS for setting in settings_of(name)})
    given = {name: FLAGS[name].value for name in known}
    given = {name: value for name, value in given.items() if value is not None}
    for name in given.keys() - {*settings_of(FLAGS.dataset)}:
        raise app.UsageError(f"--{name} does not belong to --dataset={FLAGS.dataset}")
    place = FLAGS.dataset, FLAGS.split, FLAGS.output_dir
    print(build_dataset(*place, FLAGS.num_workers, **given))


def run():
    """The entry point."""
    define_flags()
    launch("make_data", main)


if __name__ == "__main__":
    run()
