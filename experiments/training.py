"""What the launchers that train share: flags and data."""

import dataclasses
from typing import Any

import jax
from absl import flags

from experiments.mixture import open_mixture, parse_mixture
from experiments.presets import Preset
from experiments.simulation.build_dataset import build_if_missing
from experiments.splits import digest_of, open_training, opened_splits, parts_of
from experiments.weights import located
from prism_jax.completion.weights import load_pretrained, read_metadata
from prism_jax.data.datasets import DATASETS
from prism_jax.io.errors import InputError
from prism_jax.io.files import default_cache_dir
from prism_jax.models.backbone import init_backbone
from prism_jax.models.config import ModelConfig
from prism_jax.models.variables import Variables
from prism_jax.training.phase import Data, order_seed

FLAGS = flags.FLAGS


def define_training_flags() -> None:
    """The flags of a launcher that trains."""
    flags.DEFINE_string("preset", "small", "Configuration: tiny, small or paper.")
    flags.DEFINE_string("workdir", None, "Run directory.", required=True)
    flags.DEFINE_integer("seed", 0, "Seed of the initialisation and data order.")
    flags.DEFINE_bool("resume", False, "Resume the run in --workdir.")
    flags.DEFINE_integer("max_steps", None, "Stop a phase at this step.")
    flags.DEFINE_enum("dataset", "shapes", DATASETS, "Data set to train on.")
    flags.DEFINE_string("mixture", None, "Weighted data sets: shapes:1,packed:2.")
    flags.DEFINE_float("whole", None, "Share of uncropped views.", 0.0, 1.0)
    flags.DEFINE_string("data_dir", None, "Folder of the data set.")
    flags.DEFINE_integer("num_workers", 0, "Loader processes; 0 uses threads.")
    flags.DEFINE_multi_string("set", [], "Settings to change: path.to.field=value.")


_KNOWN = ("preset", "seed", "commit", "data", "samples", "pretrained", "interpolated")
"""What trainings that go on from weights keep of their metadata."""

_READ = ("reads_visibility", "seeds_read_visibility")
"""What a decoder can learn to read later."""


def beginning(
    weights: str, wanted: ModelConfig, whose: str, seed: int | None
) -> Variables:
    """What a training of a network begins with that goes on from weights.

    Weights of a network that is not the wanted one, which is ``whose``, raise
    InputError; but one that reads visibility, or has more up-sampling blocks,
    goes on from one that does not, with the parts for it as the seed makes them; and
    how far offsets reach can change.
    """
    config, variables = load_pretrained(located(weights))
    given = config.model.backbone
    blocks = len(given.up_factors)
    less = dataclasses.replace(
        wanted.backbone,
        offset_reach=given.offset_reach,
        **{
            read: getattr(wanted.backbone, read) and getattr(given, read)
            for read in _READ
        },
        up_factors=wanted.backbone.up_factors[:blocks],
        level_rates=wanted.backbone.level_rates[:blocks],
    )
    # How an object reaches the network, and with which map, is no matter of its size.
    use = {
        name: getattr(config.model, name)
        for name in ("heading", "background", "uses_visibility", "poses")
    }
    if config.model != dataclasses.replace(wanted, backbone=less, **use):
        remedy = "use the preset that they were trained with, or --set its fields"
        raise InputError(weights, f"not weights of {whose}", remedy)
    reach = wanted.backbone.offset_reach
    if dataclasses.replace(given, offset_reach=reach) != wanted.backbone:
        fresh = init_backbone(jax.random.key(seed or 0), wanted.backbone)
        variables = overlaid(fresh, variables)
    return variables


def known_of(weights: str) -> dict[str, Any]:
    """What is known of the trainings that led to weights, by name or by file."""
    metadata = read_metadata(located(weights))
    return {key: metadata[key] for key in _KNOWN if key in metadata}


def overlaid(fresh: Variables, given: Variables) -> Variables:
    """The given tree, with what only the fresh one has."""
    both = {**fresh, **given}
    for name in fresh.keys() & given.keys():
        if isinstance(fresh[name], dict):
            both[name] = overlaid(fresh[name], given[name])
    return both


def training_data(
    preset: Preset, validate_every: int, start: str | None = None
) -> Data:
    """The flags' data set as the preset reads it.

    `start` is the digest of the weights that the run goes on from: what they saw first,
    it does not see first again. Generated sets are built where missing: for a preset
    with a `num_shapes` of its own, so many shapes in a folder of its own.
    """
    weights, data_dir, changes = _place(preset)
    for name in weights:
        for split in opened_splits(name):
            build_if_missing(name, split, data_dir, **changes)
    if FLAGS.mixture is None:
        train, validation = open_training(next(iter(weights)), data_dir)
    else:
        train, validation = open_mixture(weights, data_dir, whole=FLAGS.whole)
    return Data(
        train,
        validation,
        preset.model.backbone.num_points,
        preset.model.margin,
        FLAGS.seed if start is None else order_seed(FLAGS.seed, start),
        validate_every,
        FLAGS.num_workers,
        heading=preset.model.heading,
    )


def about_training(preset: Preset, data: Data) -> dict[str, Any]:
    """What tells the training's data from others, wherever they lie."""
    weights, data_dir, _ = _place(preset)
    digests = {
        name: {split: digest_of(name, split, data_dir) for split in opened_splits(name)}
        for name in weights
    }
    sizes = {"examples": len(data.train), "validation_examples": len(data.validation)}
    if FLAGS.mixture is not None:
        about = {"mixture": weights, "digests": digests, **sizes}
        return about if FLAGS.whole is None else {**about, "whole": FLAGS.whole}
    (name,) = weights
    return {"dataset": name, "digests": digests[name], **sizes}


def parts_of_training() -> str:
    """The names of the sets that the flags' training sees."""
    weights = _weights()
    parts = (part for name in weights for part in parts_of(name, FLAGS.data_dir))
    return ", ".join(dict.fromkeys(parts))


def _weights() -> dict[str, float]:
    """The flags' data sets, and how often each is seen."""
    if FLAGS.mixture is None:
        if FLAGS.whole is not None:
            raise InputError("--whole", "needs a mixture", "set --mixture too")
        return {FLAGS.dataset: 1.0}
    return parse_mixture(FLAGS.mixture)


def _place(preset: Preset) -> tuple[dict[str, float], str | None, dict[str, Any]]:
    """The data sets and their weights, their folder, and how they are to be built where
    they are missing."""
    weights, data_dir, changes = _weights(), FLAGS.data_dir, {}
    if [*weights] == ["shapes"] and data_dir is None and preset.num_shapes:
        data_dir = str(default_cache_dir() / FLAGS.preset)
        changes = {"num_shapes": preset.num_shapes}
    return weights, data_dir, changes
