"""Pretrains a preset on the procedural corpus.

python -m experiments.pretrain --preset=small --workdir=DIR [--resume]
"""

import sys

from absl import app, flags, logging

from prism_jax.data.corpus import load_corpus
from prism_jax.io.errors import InputError
from prism_jax.presets import resolve
from prism_jax.training.leg import Source
from prism_jax.training.run import open_run
from prism_jax.training.stages import pretrain

FLAGS = flags.FLAGS
flags.DEFINE_string("preset", "small", "Configuration: tiny, small or paper.")
flags.DEFINE_string("workdir", None, "Run directory.", required=True)
flags.DEFINE_integer("seed", 0, "Seed of initialisation and data order.")
flags.DEFINE_bool("resume", False, "Go on with the run in --workdir.")
flags.DEFINE_integer("max_steps", None, "Stop after so many more steps of a phase.")
flags.DEFINE_string("cache_dir", None, "Where experiments.make_data put the corpus.")
flags.DEFINE_multi_string("set", [], "Changes, as path.to.field=value.")


def main(argv):
    """Trains, or goes on training, and says where the weights are."""
    del argv
    logging.set_verbosity(logging.WARNING)
    preset = resolve(FLAGS.preset, FLAGS.set)
    folder = open_run(FLAGS.workdir, preset, FLAGS.seed, FLAGS.resume)
    source = Source(
        load_corpus("train", cache_dir=FLAGS.cache_dir),
        load_corpus("validation", cache_dir=FLAGS.cache_dir, limit=200),
        preset.model.backbone.num_points,
        preset.model.margin,
        FLAGS.seed,
        preset.pretrain.validate_every,
    )
    pretrain(preset, source, folder, FLAGS.seed, FLAGS.max_steps)


def run():
    """Entry point: faults of the input end in one line and exit status 2."""
    try:
        app.run(main)
    except InputError as error:
        sys.exit(f"pretrain: {error}")


if __name__ == "__main__":
    run()
