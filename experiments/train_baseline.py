r"""Trains a baseline network in the same way as our own backbone.

python -m experiments.train_baseline --network=pcn --workdir=DIR [--samples=N] \
    [--resume]
"""

import dataclasses

from absl import flags

from experiments.baselines.networks import NETWORKS
from experiments.baselines.training import network_phase
from experiments.baselines.weights import save_network
from experiments.run_folder import open_run, started_from
from experiments.settings import resolve
from experiments.training import (
    about_training,
    define_training_flags,
    parts_of_training,
    training_data,
)
from prism_jax.cli.launch import launch
from prism_jax.io.errors import InputError
from prism_jax.training.config import PhaseConfig
from prism_jax.training.phase import train_phase

FLAGS = flags.FLAGS


def main():
    """Trains all stages at once; if not told otherwise, on as many samples as the
    preset's network has seen at the end of its meta-training."""
    preset = resolve(FLAGS.preset, FLAGS.set)
    sizes = NETWORKS[FLAGS.network]
    if FLAGS.preset not in sizes:
        fault = f"{FLAGS.network} has no preset {FLAGS.preset}"
        raise InputError("--preset", fault, f"use one of {', '.join(sizes)}")
    config, network = preset.pretrain, sizes[FLAGS.preset]
    num_samples = FLAGS.samples
    if num_samples is None:
        num_samples = sum(phase.num_samples for phase in config.backbone)
        num_samples += preset.meta.num_samples
    phase = PhaseConfig(FLAGS.network, num_samples, None)
    data = training_data(preset, config.validate_every)
    run = {
        "network": FLAGS.network,
        "sizes": dataclasses.asdict(network.config),  # pyright: ignore
        "pretrain": dataclasses.asdict(config),
        "samples": num_samples,
        "data": about_training(preset, data),
    }
    folder = open_run(FLAGS.workdir, run, FLAGS.seed, FLAGS.resume)
    num_points = preset.model.backbone.num_points
    training = network_phase(network, num_points, phase, config, FLAGS.seed)
    trained = train_phase(training, data, folder, FLAGS.max_steps)
    if not trained.done:
        print(f"stopped; resume with --workdir={folder} --resume")
    else:
        about = {
            "seed": FLAGS.seed,
            "commit": started_from(folder),
            "data": parts_of_training(),
            "samples": num_samples,
        }
        path = folder / "weights.safetensors"
        save_network(path, FLAGS.network, FLAGS.preset, trained.best, about)
        print(f"written {path}")


def run():
    """The entry point."""
    define_training_flags()
    names = sorted(NETWORKS)
    flags.DEFINE_enum("network", None, names, "Network to train.", required=True)
    flags.DEFINE_integer(
        "samples",
        None,
        "Training samples, repetitions included. Default: the preset's.",
        1,
    )
    launch("train_baseline", main)


if __name__ == "__main__":
    run()
