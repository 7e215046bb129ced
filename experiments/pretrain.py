"""Pretrains a preset on a data set, the procedural shapes unless told otherwise.

python -m experiments.pretrain --preset=small --workdir=DIR [--weights=FILE] [--resume]
"""

import dataclasses

from absl import flags

from experiments.settings import resolve
from experiments.training import (
    about_training,
    define_start_flag,
    define_training_flags,
    join_processes,
    parts_of_training,
    started_from_weights,
    training_data,
)
from prism_jax.cli.launch import launch
from prism_jax.training.meta import check_meta
from prism_jax.training.parallel import is_first
from prism_jax.training.pretraining import pretrain
from prism_jax.training.run import open_run, started_from
from prism_jax.weights import save_weights, sha256

FLAGS = flags.FLAGS


def main():
    """Trains, or goes on training; a finished run leaves weights.safetensors."""
    join_processes()
    preset = resolve(FLAGS.preset, FLAGS.set)
    check_meta(preset.meta)  # what follows with the same settings, perhaps days later
    config = preset.pretrain
    variables, before = started_from_weights(preset) or (None, None)
    start = None if variables is None else sha256(variables)
    num_samples = sum(phase.num_samples for phase in config.backbone)
    encoded = num_samples + config.auxiliary_samples
    data = training_data(
        preset, config.num_complete, config.validate_every, encoded, start
    )
    run = {
        "preset": dataclasses.asdict(preset),
        "start": start,
        "data": about_training(preset, data),
    }
    folder = open_run(FLAGS.workdir, run, FLAGS.seed, FLAGS.resume)
    ending = (FLAGS.max_steps, FLAGS.tensorboard)
    variables = pretrain(
        preset.config, config, data, folder, FLAGS.seed, *ending, variables
    )
    if variables is None:
        print(f"stopped; go on with --workdir={folder} --resume")
        return
    about = {
        "preset": FLAGS.preset,
        "seed": FLAGS.seed,
        "commit": started_from(folder),
        "data": parts_of_training(),
        "samples": num_samples,
        "pretrained": before,
    }
    path = folder / "weights.safetensors"
    if is_first():
        save_weights(path, preset.config, variables, about)
        print(f"written {path}")


def run():
    """The entry point."""
    define_training_flags()
    define_start_flag()
    launch("pretrain", main)


if __name__ == "__main__":
    run()
