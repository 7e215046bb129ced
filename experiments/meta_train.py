"""Meta-trains weights on a data set, the procedural shapes unless told otherwise.

python -m experiments.meta_train --preset=small --weights=FILE --workdir=DIR [--resume]
"""

import dataclasses

import jax
from absl import flags

from experiments.launch import launch, with_large_pages
from experiments.training import (
    define_training_flags,
    join_processes,
    training_data,
)
from prism_jax.data.datasets import parts_of
from prism_jax.io.errors import InputError
from prism_jax.models.initial import init_variables
from prism_jax.models.variables import Variables
from prism_jax.presets import Preset, resolve
from prism_jax.training.leg import train_leg
from prism_jax.training.meta import meta_leg
from prism_jax.training.parallel import is_first
from prism_jax.training.run import open_run, started_from
from prism_jax.weights import load_pretrained, read_metadata, save_weights, sha256

FLAGS = flags.FLAGS


def main(argv):
    """Trains, or goes on training; ends with the SHA-256 of the last variables."""
    del argv
    join_processes()
    preset = resolve(FLAGS.preset, FLAGS.set)
    config = preset.meta
    variables, before = _start(preset)
    data = training_data(preset, config.num_complete, config.validate_every)
    run = {"preset": dataclasses.asdict(preset), "start": sha256(variables)}
    folder = open_run(FLAGS.workdir, run, FLAGS.seed, FLAGS.resume)
    leg = meta_leg(variables, preset.adapt, config, FLAGS.seed)
    trained = train_leg(leg, data, folder, FLAGS.max_steps, FLAGS.tensorboard)
    if not is_first():
        return
    if trained.done:
        about = {
            "preset": FLAGS.preset,
            "seed": FLAGS.seed,
            "commit": started_from(folder),
            "data": ", ".join(parts_of(FLAGS.dataset, FLAGS.data_dir)),
            "samples": config.num_samples,
            "meta": dataclasses.asdict(config),
            "pretrained": before,
        }
        path = folder / "weights.safetensors"
        save_weights(path, preset.adapt, trained.best, about)
        print(f"written {path}")
    else:
        print(f"stopped; go on with --workdir={folder} --resume")
    print(f"sha256 {sha256(trained.last.variables)}")


def _start(preset: Preset) -> tuple[Variables, dict | None]:
    """What to start from, and what is known of it."""
    if FLAGS.weights is None:
        key = jax.random.key(FLAGS.seed)
        return init_variables(key, preset.model), None
    adapt, variables = load_pretrained(FLAGS.weights)
    if adapt.model != preset.model:
        remedy = "choose the preset that they were trained with, or --set its fields"
        raise InputError(FLAGS.weights, f"not weights of {FLAGS.preset}", remedy)
    known = ("preset", "seed", "commit", "data", "samples", "pretrained")
    metadata = read_metadata(FLAGS.weights)
    return variables, {key: metadata[key] for key in known if key in metadata}


def run():
    """The entry point."""
    with_large_pages()
    define_training_flags()
    flags.DEFINE_string("weights", None, "Pretrained weights, by name or by file.")
    launch("meta_train", main)


if __name__ == "__main__":
    run()
