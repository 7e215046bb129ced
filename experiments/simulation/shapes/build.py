"""Builds splits of the procedural shapes.

Shapes of different splits and seeds never share a seed of their own; the splits
`unseen` and `novel` have categories that no other split has.
"""

import dataclasses
import functools
import os
import pathlib
from collections.abc import Iterator
from typing import Any

from experiments.simulation.kinds import KINDS, has_maps
from experiments.simulation.shapes import (
    NOVEL_CATEGORIES,
    TRAIN_CATEGORIES,
    UNSEEN_CATEGORIES,
)
from experiments.simulation.shard_writer import build_shards
from experiments.simulation.views import (
    BOX,
    PARTIAL_POINTS,
    QUANTUM,
    SURFACE_POINTS,
    examples,
    make_views,
)
from prism_jax.data.datasets import SHAPES_VERSION, folder_of
from prism_jax.data.source import Example
from prism_jax.io.errors import InputError, choose

SPLITS = {
    "train": (12_000, 8),
    "validation": (396, 1),
    "test": (396, 1),
    "unseen": (132, 1),
    "novel": (132, 1),
}
"""Shapes of a split, and views of each, unless told otherwise. A new split comes last:
`shape_seed` counts them."""
FIRST_SPLITS = 4
"""So many were there first. Their seeds stay what they were, whatever came later."""


@dataclasses.dataclass(frozen=True)
class ShapesConfig:
    """What a split is made of. What makes no sense raises InputError.

    Attributes:
      split: one of `SPLITS`.
      num_shapes: shape i has category `i % len(categories)`, so that every prefix is
        balanced; 0 for the split's own number.
      num_views: partial clouds of each shape; 0 for the split's own number.
      partial: one of `kinds.KINDS`.
      seed: of the whole set.
      shard_shapes: shapes in a shard.
    """

    split: str
    num_shapes: int = 0
    num_views: int = 0
    partial: str = "self_occlusion"
    seed: int = 0
    shard_shapes: int = 100

    def __post_init__(self):
        choose("split", self.split, SPLITS)
        own = dict(zip(("num_shapes", "num_views"), SPLITS[self.split], strict=True))
        for name, number in own.items():
            if getattr(self, name) == 0:
                object.__setattr__(self, name, number)
        check_settings(self)

    @property
    def categories(self) -> tuple[str, ...]:
        """Of the split's shapes."""
        own = {"unseen": UNSEEN_CATEGORIES, "novel": NOVEL_CATEGORIES}
        return own.get(self.split, TRAIN_CATEGORIES)


def shape_seed(config: ShapesConfig, index: int) -> int:
    """Seed of a shape, distinct for every (seed of the set, split, index < 2**32)."""
    position = list(SPLITS).index(config.split)
    if position >= FIRST_SPLITS:
        return (position << 96) + (config.seed << 32) + index
    block = config.seed * FIRST_SPLITS + position
    return (block << 32) + index


def build_shapes(
    config: ShapesConfig,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Builds what is missing of a split and returns its folder.

    The bytes do not depend on `num_workers` (`building.build`).
    """
    shapes, step = range(config.num_shapes), config.shard_shapes
    content = {
        "generator": "prism_jax shapes",
        "generator_version": SHAPES_VERSION,
        **dataclasses.asdict(config),
        "categories": config.categories,
        "partial_points": PARTIAL_POINTS,
        "complete_points": SURFACE_POINTS,
        "quantum": QUANTUM,
    }
    return build_shards(
        folder_of("shapes", config.split, data_dir),
        content,
        [shapes[start : start + step] for start in shapes[::step]],
        functools.partial(_views, config),
        num_workers,
        progress,
        BOX,
        maps=has_maps(config.partial),
    )


def _views(config: ShapesConfig, index: int) -> Iterator[Example]:
    category = config.categories[index % len(config.categories)]
    seed = shape_seed(config, index)
    made = make_views(category, seed, config.num_views, config.partial)
    return examples(made, category, f"{index:06d}")


def check_settings(config: Any) -> None:
    """Raises InputError for a kind of partial that there is not, or a number of a
    configuration of shapes that makes no sense."""
    choose("partial", config.partial, KINDS)
    for name in ("num_shapes", "num_views", "shard_shapes", "seed"):
        value, lowest = getattr(config, name), 0 if name == "seed" else 1
        if not lowest <= value < 2**31:
            fault = f"{value} is not within {lowest} to {2**31 - 1}"
            raise InputError(name, fault, "choose another number")
