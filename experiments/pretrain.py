"""Pretrains a preset on the procedural corpus.

python -m experiments.pretrain --preset=small --workdir=DIR [--resume]
"""

from absl import flags

from experiments.launch import launch, with_large_pages
from prism_jax.data.corpus import CorpusConfig, build_corpus, load_corpus
from prism_jax.presets import Preset, resolve
from prism_jax.training.leg import Source
from prism_jax.training.run import open_run, started_from
from prism_jax.training.stages import pretrain
from prism_jax.weights import save_weights

FLAGS = flags.FLAGS
NUM_VALIDATION = 200


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("preset", "small", "Configuration: tiny, small or paper.")
    flags.DEFINE_string("workdir", None, "Run directory.", required=True)
    flags.DEFINE_integer("seed", 0, "Seed of initialisation and data order.")
    flags.DEFINE_bool("resume", False, "Go on with the run in --workdir.")
    flags.DEFINE_integer("max_steps", None, "Stop after so many more steps of a leg.")
    flags.DEFINE_string("cache_dir", None, "Where the corpus is, or is to be built.")
    flags.DEFINE_multi_string("set", [], "Changes, as path.to.field=value.")


def main(argv):
    """Trains, or goes on training; a finished run leaves weights.safetensors."""
    del argv
    preset = resolve(FLAGS.preset, FLAGS.set)
    folder = open_run(FLAGS.workdir, preset, FLAGS.seed, FLAGS.resume)
    source = open_source(preset)
    variables = pretrain(preset, source, folder, FLAGS.seed, FLAGS.max_steps)
    if variables is None:
        print(f"stopped; go on with --workdir={folder} --resume")
        return
    about = {
        "preset": FLAGS.preset,
        "seed": FLAGS.seed,
        "commit": started_from(folder),
        "data": "procedural corpus, train split",
        "samples": sum(leg.num_samples for leg in preset.pretrain.backbone),
    }
    path = folder / "weights.safetensors"
    save_weights(path, preset.adapt, variables, about)
    print(f"written {path}")


def open_source(preset: Preset) -> Source:
    """The training and validation splits, built first where they are missing."""
    for split in ("train", "validation"):
        build_corpus(split, CorpusConfig(), FLAGS.cache_dir)
    return Source(
        load_corpus("train", cache_dir=FLAGS.cache_dir),
        load_corpus("validation", cache_dir=FLAGS.cache_dir, limit=NUM_VALIDATION),
        preset.model.backbone.num_points,
        preset.model.margin,
        FLAGS.seed,
        preset.pretrain.validate_every,
    )


def run():
    """The entry point."""
    with_large_pages()
    define_flags()
    launch("pretrain", main)


if __name__ == "__main__":
    run()
