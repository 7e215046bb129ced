"""Trains a preset on a data set, by default the procedural shapes.

python -m experiments.train --preset=small --workdir=DIR [--weights=FILE] [--resume]
python -m experiments.train --phase=meta --preset=small --weights=FILE --workdir=DIR
"""

import dataclasses

import jax
from absl import flags

from experiments.pretraining import pretrain
from experiments.run_folder import check_run, open_run, started_from
from experiments.settings import resolve
from experiments.training import (
    about_training,
    beginning,
    define_training_flags,
    known_of,
    parts_of_training,
    training_data,
)
from prism_jax.cli.launch import launch
from prism_jax.completion.weights import save_weights, sha256
from prism_jax.models.initial import init_variables
from prism_jax.training.meta import check_meta, meta_phase
from prism_jax.training.phase import train_phase

FLAGS = flags.FLAGS


def main():
    """Trains, or resumes a run; a finished one leaves weights.safetensors."""
    preset, name = resolve(FLAGS.preset, FLAGS.set), FLAGS.preset
    if name == "tiny":  # which takes longer to compile than to run
        jax.config.update("jax_disable_most_optimizations", True)
    check_meta(preset.meta)  # before a pretraining too: it follows, days later
    meta = FLAGS.phase == "meta"
    config = preset.meta if meta else preset.pretrain
    variables = before = order = None
    if FLAGS.weights is not None:
        variables = beginning(FLAGS.weights, preset.model, name)
        before, order = known_of(FLAGS.weights), sha256(variables)
    elif meta:
        variables = init_variables(jax.random.key(FLAGS.seed), preset.model)
    if meta:
        num_samples = preset.meta.num_samples
    else:
        num_samples = sum(phase.num_samples for phase in preset.pretrain.backbone)
    run = {
        "phase": FLAGS.phase,
        "preset": dataclasses.asdict(preset),
        "start": None if variables is None else sha256(variables),
    }
    # Before data are built, which may take long.
    check_run(FLAGS.workdir, run, FLAGS.seed, FLAGS.resume)
    data = training_data(preset, config.validate_every, order)
    run["data"] = about_training(preset, data)
    folder = open_run(FLAGS.workdir, run, FLAGS.seed, FLAGS.resume)
    about = {
        "preset": name,
        "seed": FLAGS.seed,
        "commit": started_from(folder),
        "data": parts_of_training(),
        "samples": num_samples,
    }
    if meta:
        assert variables is not None
        phase = meta_phase(variables, preset.config, preset.meta, FLAGS.seed)
        trained = train_phase(phase, data, folder, FLAGS.max_steps)
        best = trained.best if trained.done else None
        about["meta"] = dataclasses.asdict(config)
        last = f"\nsha256 {sha256(trained.last.variables)}"
    else:
        settings = preset.config, preset.pretrain, data, folder, FLAGS.seed
        best, last = pretrain(*settings, FLAGS.max_steps, variables), ""
    path = folder / "weights.safetensors"
    if best is None:
        print(f"stopped; resume with --workdir={folder} --resume{last}")
    else:
        save_weights(path, preset.config, best, {**about, "pretrained": before})
        print(f"written {path}{last}")


def run():
    """The entry point."""
    define_training_flags()
    phases = ("pretrain", "meta")
    flags.DEFINE_enum("phase", "pretrain", phases, "meta: meta-training (Eq. 12).")
    flags.DEFINE_string("weights", None, "Initial weights, name or file.")
    launch("train", main)


if __name__ == "__main__":
    run()
