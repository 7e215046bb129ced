"""Builds splits of the procedural shapes.

Shapes of different splits and seeds never share a seed of their own; the splits
`unseen` and `novel` have categories that no other split has.
"""

import dataclasses
import os
import pathlib
from collections.abc import Iterator
from typing import ClassVar

from experiments.simulation.configs import SetConfig, shards_of
from experiments.simulation.kinds import has_maps
from experiments.simulation.shapes import (
    NOVEL_CATEGORIES,
    TRAIN_CATEGORIES,
    UNSEEN_CATEGORIES,
)
from experiments.simulation.shard_writer import build_shards
from experiments.simulation.views import BOX, STORED, examples, make_views
from prism_jax.data.datasets import SHAPES_VERSION, folder_of
from prism_jax.data.source import Example

FIRST_SPLITS = 4
"""So many were there first. Their seeds stay what they were, whatever came later."""


@dataclasses.dataclass(frozen=True)
class ShapesConfig(SetConfig):
    """Shape i has category `i % len(categories)`, so that every prefix is balanced."""

    # A new split comes last: `shape_seed` counts them.
    SIZES: ClassVar = {
        "train": {"num_shapes": 12_000, "num_views": 8},
        "validation": {"num_shapes": 396, "num_views": 1},
        "test": {"num_shapes": 396, "num_views": 1},
        "unseen": {"num_shapes": 132, "num_views": 1},
        "novel": {"num_shapes": 132, "num_views": 1},
    }

    SET: ClassVar = ("shapes", "shapes", SHAPES_VERSION)  # name, generator, version

    num_shapes: int = 0
    num_views: int = 0  # partial clouds of each shape
    partial: str = "self_occlusion"  # one of `kinds.KINDS`
    seed: int = 0  # of the whole set
    shard_shapes: int = 100

    @property
    def categories(self) -> tuple[str, ...]:
        """Of the split's shapes."""
        own = {"unseen": UNSEEN_CATEGORIES, "novel": NOVEL_CATEGORIES}
        return own.get(self.split, TRAIN_CATEGORIES)

    def examples(self, index: int) -> Iterator[Example]:
        """The views of a shape."""
        category = self.categories[index % len(self.categories)]
        seed = shape_seed(self, index)
        made = make_views(category, seed, self.num_views, self.partial)
        return examples(made, category, f"{index:06d}")


def shape_seed(config: ShapesConfig, index: int) -> int:
    """Seed of a shape, distinct for every (seed of the set, split, index < 2**32)."""
    position = list(config.SIZES).index(config.split)
    if position >= FIRST_SPLITS:
        return (position << 96) + (config.seed << 32) + index
    return ((config.seed * FIRST_SPLITS + position) << 32) + index


def build_shapes(
    config: ShapesConfig,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Builds what is missing of a split and returns its folder."""
    dataset, generator, version = config.SET
    categories = config.categories
    return build_shards(
        folder_of(dataset, config.split, data_dir),
        config.content(generator, version, categories=categories, **STORED),
        shards_of(config.num_shapes, config.shard_shapes),
        config.examples,
        num_workers,
        progress,
        BOX,
        maps=has_maps(config.partial),
    )
