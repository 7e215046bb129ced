"""The procedural corpus: builds splits of shapes with views, and reads them back.

A split is a folder of memory-mapped .npy shards and a manifest. Shapes of different
splits and seeds never share a seed of their own; the split `unseen` has the categories
that no other split has.
"""

import dataclasses
import functools
import io
import os
import pathlib
from typing import Any

import numpy as np
from jaxtyping import Int

from prism_jax.data import builds
from prism_jax.data.source import Example
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError, choose
from prism_jax.io.files import default_cache_dir
from prism_jax.simulation.partials import PARTIALS
from prism_jax.simulation.shapes import TRAIN_CATEGORIES, UNSEEN_CATEGORIES
from prism_jax.simulation.views import (
    PARTIAL_POINTS,
    QUANTUM,
    SURFACE_POINTS,
    dequantise,
    make_views,
)

SPLITS = {
    "train": (12_000, 8),
    "validation": (396, 1),
    "test": (396, 1),
    "unseen": (132, 1),
}
"""Shapes of a split, and views of each, unless told otherwise."""
GENERATOR_VERSION = 2
"""Raised with every change of shapes or partials, so that builds are never mixed."""

_ARRAYS = ("partial", "complete", "eye")
"""Of a shard, each a file of its own."""


@dataclasses.dataclass(frozen=True)
class CorpusConfig:
    """What a split is made of. What makes no sense raises InputError.

    Attributes:
      split: one of `SPLITS`.
      num_shapes: shape i has category `i % len(categories)`, so that every prefix is
        balanced; 0 for the split's own number.
      num_views: partial clouds of each shape; 0 for the split's own number.
      partial: one of `partials.PARTIALS`.
      seed: of the whole corpus.
      shard_shapes: shapes in a file.
    """

    split: str
    num_shapes: int = 0
    num_views: int = 0
    partial: str = "self_occlusion"
    seed: int = 0
    shard_shapes: int = 100

    def __post_init__(self):
        choose("split", self.split, SPLITS)
        choose("partial", self.partial, PARTIALS)
        own = dict(zip(("num_shapes", "num_views"), SPLITS[self.split], strict=True))
        for name, number in own.items():
            if getattr(self, name) == 0:
                object.__setattr__(self, name, number)
        for name in ("num_shapes", "num_views", "shard_shapes", "seed"):
            value, lowest = getattr(self, name), 0 if name == "seed" else 1
            if not lowest <= value < 2**31:
                fault = f"{value} is not within {lowest} to {2**31 - 1}"
                raise InputError(name, fault, "choose another number")

    @property
    def categories(self) -> tuple[str, ...]:
        """Of the split's shapes."""
        return UNSEEN_CATEGORIES if self.split == "unseen" else TRAIN_CATEGORIES


def shape_seed(config: CorpusConfig, index: int) -> int:
    """Seed of a shape, distinct for every (corpus seed, split, index < 2**32)."""
    block = config.seed * len(SPLITS) + list(SPLITS).index(config.split)
    return (block << 32) + index


def split_dir(split: str, data_dir: str | os.PathLike | None = None) -> pathlib.Path:
    """Folder of a split, by default in the user's cache folder."""
    choose("split", split, SPLITS)
    root = default_cache_dir() if data_dir is None else pathlib.Path(data_dir)
    return root / f"shapes-{split}"


def build_corpus(
    config: CorpusConfig,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Builds what is missing of a split and returns its folder.

    The bytes do not depend on `num_workers` (`builds.build`).
    """
    folder = split_dir(config.split, data_dir)
    starts = range(0, config.num_shapes, config.shard_shapes)
    return builds.build(
        folder,
        _content(config),
        [min(config.shard_shapes, config.num_shapes - start) for start in starts],
        lambda number: all(_file(folder, number, name).exists() for name in _ARRAYS),
        functools.partial(_build_shard, config, folder),
        "shape",
        num_workers,
        progress,
    )


class Corpus:
    """A built split as a Source: item i is view `i % views` of shape `i // views`.

    A split that is missing, unfinished or damaged raises InputError.
    """

    def __init__(self, split: str, data_dir: str | os.PathLike | None = None):
        self.root = split_dir(split, data_dir)
        command = f"python -m experiments.make_data --dataset=shapes --split={split}"
        where = "" if data_dir is None else f" --output_dir={data_dir}"
        remedy = f"build it: {command}{where}"
        manifest = builds.read_manifest(self.root, remedy, GENERATOR_VERSION)
        builds.verify(self.root, manifest["files"], "delete it and build again")
        self.categories = tuple(manifest["categories"])
        self.views = manifest["num_views"]
        self.num_shapes = manifest["num_shapes"]
        self._shard_shapes = manifest["shard_shapes"]
        self._shards: dict[tuple[int, str], np.ndarray] = {}

    @property
    def objects(self) -> Int[np.ndarray, " N"]:
        """Every shape as often as it was seen."""
        return np.repeat(np.arange(self.num_shapes), self.views)

    def __len__(self) -> int:
        return self.num_shapes * self.views

    def __getitem__(self, index: int) -> Example:
        shape, view = divmod(range(len(self))[index], self.views)
        shard, row = divmod(shape, self._shard_shapes)
        eye = np.array(self._array(shard, "eye")[row, view])
        return Example(
            dequantise(self._array(shard, "complete")[row]),
            dequantise(self._array(shard, "partial")[row, view]),
            None if np.isnan(eye).any() else eye,
            self.categories[shape % len(self.categories)],
            f"{shape:06d}/{view:02d}",
            ordered=True,
        )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_shards": {}}

    def _array(self, shard: int, name: str) -> np.ndarray:
        """A shard's array, mapped into memory once."""
        key = shard, name
        if key not in self._shards:
            path = _file(self.root, shard, name)
            self._shards[key] = np.load(path, mmap_mode="r", allow_pickle=False)
        return self._shards[key]


def _content(config: CorpusConfig) -> dict[str, Any]:
    return {
        "generator": "prism_jax shapes",
        "generator_version": GENERATOR_VERSION,
        **dataclasses.asdict(config),
        "categories": config.categories,
        "partial_points": PARTIAL_POINTS,
        "complete_points": SURFACE_POINTS,
        "quantum": QUANTUM,
    }


def _file(folder: pathlib.Path, number: int, name: str) -> pathlib.Path:
    return folder / f"shard-{number:05d}.{name}.npy"


def _build_shard(config: CorpusConfig, folder: pathlib.Path, number: int) -> None:
    start = number * config.shard_shapes
    rows = [
        make_views(
            config.categories[index % len(config.categories)],
            shape_seed(config, index),
            config.num_views,
            config.partial,
        )
        for index in range(start, min(start + config.shard_shapes, config.num_shapes))
    ]
    for name, column in zip(_ARRAYS, zip(*rows, strict=True), strict=True):
        buffer = io.BytesIO()
        np.save(buffer, np.stack(column), allow_pickle=False)
        write_bytes(_file(folder, number, name), buffer.getvalue())
