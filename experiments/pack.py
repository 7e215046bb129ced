"""Packs data sets into one folder of shards for training.

python -m experiments.pack --dataset=roboarm --dataset=shapes --limit=4000 \
    --split=train --output_dir=DIR
"""

import pathlib

from absl import flags

from experiments.simulation.build_dataset import build_if_missing
from experiments.simulation.packing import PackConfig, pack
from experiments.splits import digest_of, training_split, validation_split
from prism_jax.cli.launch import launch
from prism_jax.data.datasets import DATASETS, open_dataset

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_multi_enum("dataset", ["shapes"], DATASETS, "Data sets to pack.")
    flags.DEFINE_string("data_dir", None, "Folder of the data sets.")
    flags.DEFINE_enum("split", "train", ("train", "validation"), "Purpose.")
    flags.DEFINE_string("output_dir", None, "Output folder.", required=True)
    flags.DEFINE_integer("limit", 0, "Maximum per data set; 0 for all.", 0)
    flags.DEFINE_integer("num_partial", 2048, "Points per partial cloud.", 1)
    flags.DEFINE_integer("num_complete", 16_384, "Points per complete cloud.", 1)
    flags.DEFINE_integer("num_workers", None, "Default: one per core.", 0)


def main():
    """Packs what is missing, and prints the folder."""
    split_of = training_split if FLAGS.split == "train" else validation_split
    sources, digests = {}, {}
    for name in FLAGS.dataset:
        place = (name, split_of(name), FLAGS.data_dir)
        build_if_missing(*place)
        sources[name], digests[name] = open_dataset(*place), digest_of(*place)
    config = PackConfig(FLAGS.num_partial, FLAGS.num_complete, FLAGS.limit)
    folder = pathlib.Path(FLAGS.output_dir) / FLAGS.split
    print(pack(sources, folder, config, FLAGS.num_workers, digests=digests))


def run():
    """The entry point."""
    define_flags()
    launch("pack", main)


if __name__ == "__main__":
    run()
