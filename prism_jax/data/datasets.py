"""Every data set by the name that flags use, its splits, and how it is opened."""

import dataclasses
import inspect
import pathlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from prism_jax.data.recordings import RecordedCells
from prism_jax.data.scenes import Scenes
from prism_jax.data.shapenet import ShapeNet
from prism_jax.data.shards import Shards
from prism_jax.data.source import Source
from prism_jax.io.errors import InputError, StrPath, choose
from prism_jax.io.files import default_cache_dir

SHAPES_VERSION, OPEN_VERSION, ROBOARM_VERSION, OBJECTS_VERSION = 2, 1, 1, 1
CELLS_VERSION, SCENES_VERSION = 1, 1
"""Raised with every change of what is drawn, so that builds are never mixed."""


@dataclasses.dataclass(frozen=True)
class DataSet:
    """What is known of a data set before it is opened."""

    # Its `Source`, by folder and split, and by options where a set has some.
    open: Callable[..., Source]
    # Those that there are; empty where `open` checks them itself.
    splits: tuple[str, ...] = ()
    # The split that a training sees; None where a set is for tests alone.
    training: str | None = "train"
    # The split of its own that a training is validated on.
    validation: str | None = None
    # Where below the root a split's folder lies, for sets with a manifest.
    folder: str | None = None
    # Whether it is built on the machine, by default in the cache folder.
    generated: bool = False
    # Whose meshes its training split is made of, and how they are licensed.
    licence: str = "as its publisher licenses it"


def _built(
    name: str, version: int, splits: str, licence: str, kind: Callable = Shards
) -> DataSet:
    """What is known of a set that `experiments.make_data` builds, by the version of
    what draws it."""
    command = f"python -m experiments.make_data --dataset={name}"

    def opened(folder: pathlib.Path, split: str) -> Source:
        how = f"{command} --split={split} --output_dir={folder.parent}"
        remedy = f"build it in a clone of the repository: {how}"
        return kind(folder, remedy, generator_version=version)

    names = tuple(splits.split())
    return DataSet(
        opened,
        splits=names,
        validation="validation" if len(names) > 1 else None,
        folder=f"{name}-{{split}}",
        generated=True,
        licence=licence,
    )


_ALL = "train validation test"
_PROCEDURAL = "procedural, made by prism_jax (Apache-2.0), nobody else's meshes"
_ARMS = "arms of example-robot-data (tiago Apache-2.0, pr2 BSD, tiago_pro Apache-2.0, "
_ARMS += "romeo BSD, talos Apache-2.0), the rest procedural"
_SWEET_HOME = "Blend Swap models of Debian's sweethome3d-furniture (CC0 1.0, CC BY "
_SWEET_HOME += "3.0), whose makers docs/data.md and the manifest name"
_MORE_ARMS = "arms of example-robot-data as in roboarm; of rtb-data, KUKA arms by "
_MORE_ARMS += "ROS-Industrial (BSD, Apache-2.0); the rest procedural"
_SCENES = f"{_PROCEDURAL}, unless built with objects"

DATASETS: Mapping[str, DataSet] = {
    "shapes": _built("shapes", SHAPES_VERSION, f"{_ALL} unseen novel", _PROCEDURAL),
    "open": _built("open", OPEN_VERSION, "train", _PROCEDURAL),
    "roboarm": _built("roboarm", ROBOARM_VERSION, _ALL, _ARMS, RecordedCells),
    "objects": _built("objects", OBJECTS_VERSION, _ALL, _SWEET_HOME),
    "cells": _built("cells", CELLS_VERSION, "train validation", _MORE_ARMS),
    "scenes": _built("scenes", SCENES_VERSION, _ALL, _SCENES, Scenes),
    "packed": DataSet(
        lambda folder, split: Shards(folder),
        validation="validation",
        folder="{split}",
        licence="as those are licensed that were packed",
    ),
    "recordings": DataSet(
        lambda folder, split: RecordedCells(folder),
        splits=("all",),
        training="all",
        folder="",
    ),
    "shapenet55": DataSet(partial(ShapeNet, "ShapeNet-55")),
    "shapenet34": DataSet(partial(ShapeNet, "ShapeNet-34")),
    "shapenet_unseen21": DataSet(partial(ShapeNet, "ShapeNet-Unseen21"), training=None),
}
"""Public sets are named last, and never downloaded."""


def open_dataset(
    name: str, split: str, data_dir: StrPath | None = None, **options: Any
) -> Source:
    """A data set's split as a Source.

    `data_dir` holds the set: the folder given to `make_data` or to `experiments.pack`,
    or the root of recordings or of a public set in its published layout. Recordings
    have the one split "all". `options` are the set's own, such as ShapeNet's
    `difficulty`. Anything that is not there, or not as it should be, raises InputError.
    """
    known = DATASETS[choose("data set", name, DATASETS)]
    folder = folder_of(name, split, data_dir)
    taken = tuple(inspect.signature(known.open).parameters)[2:]
    for option in options:
        if option not in taken:
            fault = f"not an option of {name}"
            raise InputError(option, fault, f"its options: {' '.join(taken) or 'none'}")
    return known.open(folder, split, **options)


def folder_of(name: str, split: str, data_dir: StrPath | None = None) -> pathlib.Path:
    """Where a split lies: in the root, if it has no folder of its own there."""
    known = DATASETS[name]
    if known.splits:
        choose("split", split, known.splits)
    if data_dir is None and not known.generated:
        raise InputError(name, "not generated", "set --data_dir to its folder")
    root = default_cache_dir() if data_dir is None else pathlib.Path(data_dir)
    return root / (known.folder or "").format(split=split)


def mesh_licences(name: str) -> str:
    """Whose meshes a set's training split is made of, and how they are licensed."""
    return DATASETS[name].licence if name in DATASETS else DataSet.licence
