"""What the launchers that train share: flags and data."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from absl import flags

from experiments.mixture import open_mixture, parse_mixture
from experiments.presets import Preset
from experiments.simulation.build_dataset import build_if_missing
from experiments.splits import (
    digest_of,
    held_out,
    parts_of,
    training_split,
    validation_place,
    validation_rows,
)
from experiments.weights import located
from prism_jax.completion.weights import load_pretrained, read_metadata
from prism_jax.data.datasets import DATASETS
from prism_jax.io.errors import InputError
from prism_jax.io.files import default_cache_dir
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
    flags.DEFINE_string(
        "validation", None, "Sets to validate on: objects,shapes/novel. Default: own."
    )
    flags.DEFINE_string("data_dir", None, "Folder of the data set.")
    flags.DEFINE_integer("num_workers", 0, "Loader processes; 0 uses threads.")
    flags.DEFINE_multi_string("set", [], "Settings to change: path.to.field=value.")


_KNOWN = ("preset", "seed", "commit", "data", "samples", "pretrained", "interpolated")
"""What trainings that go on from weights keep of their metadata."""


def beginning(weights: str, wanted: ModelConfig, whose: str) -> Variables:
    """What a training of a network begins with that goes on from weights.

    Weights of a network that is not the wanted one, which is ``whose``, raise
    InputError; but how far offsets reach, and how an object reaches the network, can
    change.
    """
    config, variables = load_pretrained(located(weights))
    reach = config.model.backbone.offset_reach
    use = {
        name: getattr(config.model, name)
        for name in ("heading", "background", "uses_visibility", "poses")
    }
    backbone = dataclasses.replace(wanted.backbone, offset_reach=reach)
    if config.model != dataclasses.replace(wanted, backbone=backbone, **use):
        remedy = "use the preset that they were trained with, or --set its fields"
        raise InputError(weights, f"not weights of {whose}", remedy)
    return variables


def known_of(weights: str) -> dict[str, Any]:
    """What is known of the trainings that led to weights, by name or by file."""
    metadata = read_metadata(located(weights))
    return {key: metadata[key] for key in _KNOWN if key in metadata}


def training_data(
    preset: Preset, validate_every: int, start: str | None = None
) -> Data:
    """The flags' data set as the preset reads it.

    `start` is the digest of the weights that the run goes on from: what they saw first,
    it does not see first again. Generated sets are built where missing: for a preset
    with a `num_shapes` of its own, so many shapes in a folder of its own.
    """
    weights, data_dir, changes = _place(preset)
    for name, split in _opened(weights):
        build_if_missing(name, split, data_dir, **changes)
    validated = _validated(weights)
    if validated:
        train = open_mixture(weights, data_dir)
        validation = {name: validation_rows(name, data_dir) for name in validated}
    else:
        (name,) = weights
        train, rest = held_out(name, data_dir)
        validation = {name: rest}
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
        f"{name}/{split}": digest_of(name, split, data_dir)
        for name, split in _opened(weights)
    }
    sizes = {name: len(source) for name, source in data.validation.items()}
    return {
        "mixture": weights,
        "digests": digests,
        "examples": len(data.train),
        "validation_examples": sizes,
    }


def _validated(weights: Mapping[str, float]) -> list[str]:
    """What is validated on, as `validation_place` reads it; none where examples of the
    one set are held out."""
    if FLAGS.validation is not None:
        return FLAGS.validation.split(",")
    having = [name for name in weights if DATASETS[name].validation is not None]
    if not having and len(weights) > 1:
        fault = "has no set with a validation split of its own"
        raise InputError("--mixture", fault, "set --validation=shapes")
    return having


def _opened(weights: Mapping[str, float]) -> list[tuple[str, str]]:
    """Every set and split that is read."""
    trained = [(name, training_split(name)) for name in weights]
    return [*trained, *map(validation_place, _validated(weights))]


def parts_of_training() -> str:
    """The names of the sets that the flags' training sees."""
    weights = _weights()
    parts = (part for name in weights for part in parts_of(name, FLAGS.data_dir))
    return ", ".join(dict.fromkeys(parts))


def _weights() -> dict[str, float]:
    """The flags' data sets, and how often each is seen."""
    return parse_mixture(FLAGS.mixture or FLAGS.dataset)


def _place(preset: Preset) -> tuple[dict[str, float], str | None, dict[str, Any]]:
    """The data sets and their weights, their folder, and how they are to be built where
    they are missing."""
    weights, data_dir, changes = _weights(), FLAGS.data_dir, {}
    if [*weights] == ["shapes"] and data_dir is None and preset.num_shapes:
        data_dir = str(default_cache_dir() / FLAGS.preset)
        changes = {"num_shapes": preset.num_shapes}
    return weights, data_dir, changes
