"""Pretrains a preset on the procedural corpus.

python -m experiments.pretrain --preset=small --workdir=DIR [--resume]
"""

import sys

import jax
from absl import app, flags

from prism_jax.data.corpus import load_corpus
from prism_jax.io.errors import InputError
from prism_jax.models.backbone import init_backbone
from prism_jax.presets import resolve
from prism_jax.training.backbone_phase import train_backbone_phase
from prism_jax.training.run import open_run

FLAGS = flags.FLAGS
flags.DEFINE_string("preset", "small", "Configuration: tiny, small or paper.")
flags.DEFINE_string("workdir", None, "Run directory.", required=True)
flags.DEFINE_integer("seed", 0, "Seed of initialisation and data order.")
flags.DEFINE_bool("resume", False, "Go on with the run in --workdir.")
flags.DEFINE_integer("max_steps", None, "Stop after so many more steps of a phase.")
flags.DEFINE_string("cache_dir", None, "Where experiments.make_data put the corpus.")
flags.DEFINE_multi_string("set", [], "Changes, as path.to.field=value.")


def main(argv):
    """Runs the phases in turn."""
    del argv
    preset = resolve(FLAGS.preset, FLAGS.set)
    folder = open_run(FLAGS.workdir, preset, FLAGS.seed, FLAGS.resume)
    data = tuple(
        load_corpus(split, cache_dir=FLAGS.cache_dir)
        for split in ("train", "validation")
    )
    variables = init_backbone(jax.random.key(FLAGS.seed), preset.backbone)
    for phase in preset.pretrain.backbone:
        variables, done = train_backbone_phase(
            variables,
            preset.backbone,
            phase,
            preset.pretrain,
            preset.margin,
            data,
            folder,
            FLAGS.seed,
            FLAGS.max_steps,
        )
        if not done:
            return


def run():
    """Entry point: faults of the input end in one line and exit status 2."""
    try:
        app.run(main)
    except InputError as error:
        sys.exit(f"pretrain: {error}")


if __name__ == "__main__":
    run()
