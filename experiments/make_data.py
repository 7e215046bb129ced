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
    flags.DEFINE_enum("dataset", "shapes", BUILDERS, "Data set to build.")
    flags.DEFINE_enum("split", "train", DATASETS["shapes"].splits, "Split to build.")
    flags.DEFINE_string("output_dir", None, "Default: the user cache.")
    flags.DEFINE_integer("num_workers", None, "Default: one per core.", 0)
    flags.DEFINE_integer("seed", None, "Seed of the data set.")
    flags.DEFINE_integer("num_shapes", None, "shapes, open: number of shapes.")
    flags.DEFINE_integer("num_views", None, "Partial clouds per shape or model.")
    flags.DEFINE_string("partial", None, "shapes, models: kind of partial clouds.")
    flags.DEFINE_integer("num_scenes", None, "scenes: number of scenes.")
    flags.DEFINE_list(
        "sources", None, "scenes: comma-separated, from shapes, open, objects."
    )
    flags.DEFINE_integer("num_sequences", None, "roboarm: number of sequences.")
    flags.DEFINE_integer("num_cells", None, "cells: number of cells.")
    flags.DEFINE_integer("num_frames", None, "roboarm, cells: frames each.")
    flags.DEFINE_multi_string("urdf", None, "roboarm: URDF files of your own robots.")
    flags.DEFINE_string("catalogue_dir", None, "objects, scenes. Default: Debian's.")
    flags.DEFINE_string("mesh_dir", None, "meshes: folder of meshes, complete clouds.")


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
