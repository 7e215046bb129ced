"""Builds splits of the models that people made."""

import dataclasses
import functools
import hashlib
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np

from experiments.simulation.configs import SetConfig, shards_of
from experiments.simulation.kinds import has_maps
from experiments.simulation.objects.catalogues import (
    CATALOGUES,
    CATEGORIES,
    FOLDER,
    PACKAGE,
    Model,
    category_of,
)
from experiments.simulation.objects.survey import survey
from experiments.simulation.shard_writer import build_shards
from experiments.simulation.views import BOX, STORED, Views, examples, views_of
from prism_jax.data.datasets import OBJECTS_VERSION, folder_of
from prism_jax.data.source import Example
from prism_jax.io.atomic import make_output_dir

SHARD_MODELS = 20


@dataclasses.dataclass(frozen=True)
class ObjectsConfig(SetConfig):
    """What a split of the models is made of."""

    SIZES: ClassVar = {
        "train": {"num_views": 8},
        "validation": {"num_views": 1},
        "test": {"num_views": 1},
    }

    num_views: int = 0  # partial clouds of each model
    partial: str = "self_occlusion"  # one of `kinds.KINDS`
    seed: int = 0  # of the whole set


def build_objects(
    config: ObjectsConfig,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
    catalogue_dir: str | os.PathLike = FOLDER,
) -> pathlib.Path:
    """Builds what is missing of a split and returns its folder.

    The manifest names every model with its maker, licence and the digest of its mesh,
    and every model that is left out with the reason. A catalogue that is not in
    `catalogue_dir` raises InputError.
    """
    folder = make_output_dir(folder_of("objects", config.split, data_dir))
    found = survey([config.split], catalogue_dir, progress)
    models = [model for model, _ in found.models]
    catalogues = [
        {**known._asdict(), "version": found.versions[known.name]}
        for known in CATALOGUES
        if known.name in found.versions
    ]
    content = config.content(
        "objects",
        OBJECTS_VERSION,
        categories=CATEGORIES,
        **STORED,
        package=PACKAGE,
        catalogues=catalogues,
        models=[
            {
                "catalogue": model.catalogue,
                "name": model.name,
                "title": model.title,
                "category": category_of(model.title),
                "creator": model.creator,
                "licence": model.licence,
                "digest": digest,
            }
            for model, digest in found.models
        ],
        left_out=found.left_out,
    )
    return build_shards(
        folder,
        content,
        shards_of(len(models), SHARD_MODELS),
        functools.partial(_examples, config, models),
        num_workers,
        progress,
        BOX,
        maps=has_maps(config.partial),
    )


def model_views(config: ObjectsConfig, model: Model) -> Views:
    """`views_of` a model, by the seed, the model's identity and its mesh alone."""
    digest = hashlib.sha256(f"{config.seed}/{model.identity}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "little"))
    return views_of(model.load(), rng, config.num_views, config.partial, two_sided=True)


def _examples(
    config: ObjectsConfig, models: Sequence[Model], number: int
) -> Iterator[Example]:
    model = models[number]
    made = model_views(config, model)
    yield from examples(made, category_of(model.title), model.identity)
