"""Meta-trains weights on a data set, the procedural shapes unless told otherwise.

python -m experiments.meta_train --preset=small --weights=FILE --workdir=DIR [--resume]
"""

import dataclasses

import jax
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
from prism_jax.models.initial import init_variables
from prism_jax.models.variables import Variables
from prism_jax.presets import Preset
from prism_jax.training.meta import meta_phase
from prism_jax.training.parallel import is_first
from prism_jax.training.phase import train_phase
from prism_jax.training.run import open_run, started_from
from prism_jax.weights import save_weights, sha256

FLAGS = flags.FLAGS


def main():
    """Trains, or goes on training; ends with the SHA-256 of the last variables."""
    join_processes()
    preset = resolve(FLAGS.preset, FLAGS.set)
    config = preset.meta
    variables, before = started_from_weights(preset) or (_fresh(preset), None)
    start = sha256(variables)
    data = training_data(
        preset,
        config.num_complete,
        config.validate_every,
        config.num_samples,
        start if FLAGS.weights else None,
    )
    run = {
        "preset": dataclasses.asdict(preset),
        "start": start,
        "data": about_training(preset, data),
    }
    folder = open_run(FLAGS.workdir, run, FLAGS.seed, FLAGS.resume)
    phase = meta_phase(variables, preset.config, config, FLAGS.seed)
    trained = train_phase(phase, data, folder, FLAGS.max_steps, FLAGS.tensorboard)
    if not is_first():
        return
    if trained.done:
        about = {
            "preset": FLAGS.preset,
            "seed": FLAGS.seed,
            "commit": started_from(folder),
            "data": parts_of_training(),
            "samples": config.num_samples,
            "meta": dataclasses.asdict(config),
            "pretrained": before,
        }
        path = folder / "weights.safetensors"
        save_weights(path, preset.config, trained.best, about)
        print(f"written {path}")
    else:
        print(f"stopped; go on with --workdir={folder} --resume")
    print(f"sha256 {sha256(trained.last.variables)}")


def _fresh(preset: Preset) -> Variables:
    return init_variables(jax.random.key(FLAGS.seed), preset.model)


def run():
    """The entry point."""
    define_training_flags()
    define_start_flag()
    launch("meta_train", main)


if __name__ == "__main__":
    run()
