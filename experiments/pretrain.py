"""Pretrains a preset on a data set, the procedural shapes unless told otherwise.

python -m experiments.pretrain --preset=small --workdir=DIR [--resume]
"""

from absl import flags

from experiments.launch import launch, with_large_pages
from prism_jax.data.datasets import (
    DATASETS,
    build_if_missing,
    open_training,
)
from prism_jax.data.source import Source
from prism_jax.presets import Preset, resolve
from prism_jax.training.indices import index_table
from prism_jax.training.leg import Data
from prism_jax.training.run import open_run, started_from
from prism_jax.training.stages import pretrain
from prism_jax.weights import save_weights

FLAGS = flags.FLAGS


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("preset", "small", "Configuration: tiny, small or paper.")
    flags.DEFINE_string("workdir", None, "Run directory.", required=True)
    flags.DEFINE_integer("seed", 0, "Seed of initialisation and data order.")
    flags.DEFINE_bool("resume", False, "Go on with the run in --workdir.")
    flags.DEFINE_integer("max_steps", None, "Stop after so many more steps of a leg.")
    flags.DEFINE_enum("dataset", "shapes", DATASETS, "What to train on.")
    flags.DEFINE_string("data_dir", None, "Its folder; shapes and roboarm have one.")
    flags.DEFINE_integer("num_workers", 0, "Processes that read ahead; 0 for threads.")
    flags.DEFINE_multi_string("set", [], "Changes, as path.to.field=value.")


def main(argv):
    """Trains, or goes on training; a finished run leaves weights.safetensors."""
    del argv
    preset = resolve(FLAGS.preset, FLAGS.set)
    sources = open_sources()
    folder = open_run(FLAGS.workdir, preset, FLAGS.seed, FLAGS.resume)
    data = make_data(preset, *sources)
    variables = pretrain(preset, data, folder, FLAGS.seed, FLAGS.max_steps)
    if variables is None:
        print(f"stopped; go on with --workdir={folder} --resume")
        return
    about = {
        "preset": FLAGS.preset,
        "seed": FLAGS.seed,
        "commit": started_from(folder),
        "data": FLAGS.dataset,
        "samples": sum(leg.num_samples for leg in preset.pretrain.backbone),
    }
    path = folder / "weights.safetensors"
    save_weights(path, preset.adapt, variables, about)
    print(f"written {path}")


def open_sources() -> tuple[Source, Source]:
    """To train on and to validate with; generated sets are built where missing."""
    for split in ("train", "validation"):
        build_if_missing(FLAGS.dataset, split, FLAGS.data_dir)
    return open_training(FLAGS.dataset, FLAGS.data_dir)


def make_data(preset: Preset, train: Source, validation: Source) -> Data:
    """The sources as the preset reads them, with the encoder's indices."""
    model, config = preset.model, preset.pretrain
    data = Data(
        train,
        validation,
        model.backbone.num_points,
        model.margin,
        FLAGS.seed,
        config.validate_every,
        FLAGS.num_workers,
    )
    if FLAGS.num_workers:
        return data
    framing = data.framing(config.num_complete)
    return data._replace(indices=index_table(train, framing, model.backbone))


def run():
    """The entry point."""
    with_large_pages()
    define_flags()
    launch("pretrain", main)


if __name__ == "__main__":
    run()
