"""Builds the data set `open`: every shape a kind of its own."""

import dataclasses
import functools
import os
import pathlib
from collections.abc import Iterator

from experiments.simulation.kinds import has_maps
from experiments.simulation.open_shapes import CATEGORY, make_open_shape
from experiments.simulation.shapes import category_rng
from experiments.simulation.shapes.build import check_settings
from experiments.simulation.shard_writer import build_shards
from experiments.simulation.views import (
    BOX,
    PARTIAL_POINTS,
    QUANTUM,
    SURFACE_POINTS,
    examples,
    views_of,
)
from prism_jax.data.datasets import DATASETS, OPEN_VERSION, folder_of
from prism_jax.data.source import Example
from prism_jax.io.errors import choose


@dataclasses.dataclass(frozen=True)
class OpenConfig:
    """What the split is made of. What makes no sense raises InputError.

    Attributes:
      split: the one that there is, "train".
      num_shapes: how many; every prefix of them is the same.
      num_views: partial clouds of each shape.
      partial: one of `kinds.KINDS`.
      seed: of the whole set.
      shard_shapes: shapes in a shard.
    """

    split: str = "train"
    num_shapes: int = 12_000
    num_views: int = 8
    partial: str = "self_occlusion"
    seed: int = 0
    shard_shapes: int = 100

    def __post_init__(self):
        choose("split", self.split, DATASETS["open"].splits)
        check_settings(self)


def build_open_shapes(
    config: OpenConfig,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Builds what is missing of the split and returns its folder.

    The bytes do not depend on `num_workers` (`building.build`).
    """
    shapes, step = range(config.num_shapes), config.shard_shapes
    content = {
        "generator": "prism_jax open shapes",
        "generator_version": OPEN_VERSION,
        **dataclasses.asdict(config),
        "categories": [CATEGORY],
        "partial_points": PARTIAL_POINTS,
        "complete_points": SURFACE_POINTS,
        "quantum": QUANTUM,
    }
    return build_shards(
        folder_of("open", config.split, data_dir),
        content,
        [shapes[start : start + step] for start in shapes[::step]],
        functools.partial(_views, config),
        num_workers,
        progress,
        BOX,
        maps=has_maps(config.partial),
    )


def _views(config: OpenConfig, index: int) -> Iterator[Example]:
    seed = (config.seed << 32) + index
    mesh, rng = make_open_shape(seed), category_rng(CATEGORY, seed, 1)
    views = views_of(mesh, rng, config.num_views, config.partial)
    return examples(views, CATEGORY, f"{index:06d}")
