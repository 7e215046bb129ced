"""Builds the data set `open`: every shape a kind of its own."""

import dataclasses
import os
import pathlib
from collections.abc import Iterator
from typing import ClassVar

from experiments.simulation.open_shapes import CATEGORY, make_open_shape
from experiments.simulation.shapes import category_rng
from experiments.simulation.shapes.build import ShapesConfig, build_procedural
from experiments.simulation.views import examples, views_of
from prism_jax.data.datasets import OPEN_VERSION
from prism_jax.data.source import Example


@dataclasses.dataclass(frozen=True)
class OpenConfig(ShapesConfig):
    """What the one split is made of."""

    SIZES: ClassVar = {"train": {"num_shapes": 12_000, "num_views": 8}}

    split: str = "train"


def build_open_shapes(
    config: OpenConfig,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Builds what is missing of the split and returns its folder, as `build_shapes`."""
    kind = ("open", "open shapes", OPEN_VERSION, [CATEGORY])
    return build_procedural(kind, config, _views, data_dir, num_workers, progress)


def _views(config: ShapesConfig, index: int) -> Iterator[Example]:
    seed = (config.seed << 32) + index
    mesh, rng = make_open_shape(seed), category_rng(CATEGORY, seed, 1)
    views = views_of(mesh, rng, config.num_views, config.partial)
    return examples(views, CATEGORY, f"{index:06d}")
