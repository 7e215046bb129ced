"""Pretrains a preset on a data set, the procedural shapes unless told otherwise.

python -m experiments.pretrain --preset=small --workdir=DIR [--resume]
"""

import dataclasses

from absl import flags

from experiments.launch import launch, with_large_pages
from experiments.training import (
    define_training_flags,
    join_processes,
    training_data,
)
from prism_jax.data.datasets import parts_of
from prism_jax.presets import resolve
from prism_jax.training.run import open_run, started_from
from prism_jax.training.stages import pretrain
from prism_jax.weights import save_weights

FLAGS = flags.FLAGS


def main(argv):
    """Trains, or goes on training; a finished run leaves weights.safetensors."""
    del argv
    join_processes()
    preset = resolve(FLAGS.preset, FLAGS.set)
    config = preset.pretrain
    data = training_data(preset, config.num_complete, config.validate_every)
    settings = dataclasses.asdict(preset)
    folder = open_run(FLAGS.workdir, settings, FLAGS.seed, FLAGS.resume)
    ending = (FLAGS.max_steps, FLAGS.tensorboard)
    variables = pretrain(preset, data, folder, FLAGS.seed, *ending)
    if variables is None:
        print(f"stopped; go on with --workdir={folder} --resume")
        return
    about = {
        "preset": FLAGS.preset,
        "seed": FLAGS.seed,
        "commit": started_from(folder),
        "data": ", ".join(parts_of(FLAGS.dataset, FLAGS.data_dir)),
        "samples": sum(leg.num_samples for leg in config.backbone),
    }
    path = folder / "weights.safetensors"
    save_weights(path, preset.adapt, variables, about)
    print(f"written {path}")


def run():
    """The entry point."""
    with_large_pages()
    define_training_flags()
    launch("pretrain", main)


if __name__ == "__main__":
    run()
