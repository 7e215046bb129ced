"""Builds the data sets that are made on the machine, by the name that flags use.

What a builder needs is imported when it runs: a program that only opens data sets needs
none of it.
"""

import inspect
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from prism_jax.data.datasets import GENERATED, digest_of, folder_of
from prism_jax.io.errors import InputError, choose, require

_Place = str | os.PathLike | None


def _shapes(
    split: str,
    data_dir: _Place,
    num_workers: int | None,
    num_shapes: int = 0,
    num_views: int = 0,
    partial: str = "self_occlusion",
    seed: int = 0,
) -> pathlib.Path:
    from experiments.simulation.shapes.build import ShapesConfig, build_shapes

    config = ShapesConfig(split, num_shapes, num_views, partial, seed)
    return build_shapes(config, data_dir, num_workers)


def _open(
    split: str,
    data_dir: _Place,
    num_workers: int | None,
    num_shapes: int = 12_000,
    num_views: int = 8,
    partial: str = "self_occlusion",
    seed: int = 0,
) -> pathlib.Path:
    from experiments.simulation.open_shapes.build import OpenConfig, build_open_shapes

    config = OpenConfig(split, num_shapes, num_views, partial, seed)
    return build_open_shapes(config, data_dir, num_workers)


def _roboarm(
    split: str,
    data_dir: _Place,
    num_workers: int | None,
    num_sequences: int = 20,
    num_frames: int = 10,
    seed: int = 0,
    urdf: Sequence[str] = (),
) -> pathlib.Path:
    from experiments.simulation.roboarm.build import build_roboarm
    from experiments.simulation.roboarm.models import own_arm

    return build_roboarm(
        split,
        folder_of("roboarm", split, data_dir),
        num_sequences,
        num_frames,
        seed,
        num_workers,
        arms=[own_arm(path) for path in urdf] or None,
    )


def _cells(
    split: str,
    data_dir: _Place,
    num_workers: int | None,
    num_cells: int = 0,
    num_frames: int = 2,
    seed: int = 0,
) -> pathlib.Path:
    from experiments.simulation.roboarm.cells import CellsConfig, build_cells

    config = CellsConfig(split, num_cells, num_frames, seed)
    return build_cells(config, data_dir, num_workers)


def _objects(
    split: str,
    data_dir: _Place,
    num_workers: int | None,
    num_views: int = 0,
    partial: str = "self_occlusion",
    seed: int = 0,
    catalogue_dir: str | None = None,
) -> pathlib.Path:
    from experiments.simulation.objects.build import ObjectsConfig, build_objects
    from experiments.simulation.objects.catalogues import FOLDER

    config = ObjectsConfig(split, num_views, partial, seed)
    place = catalogue_dir or FOLDER
    return build_objects(config, data_dir, num_workers, catalogue_dir=place)


def _scenes(
    split: str,
    data_dir: _Place,
    num_workers: int | None,
    num_scenes: int = 0,
    sources: Sequence[str] = ("shapes", "open"),
    seed: int = 0,
    catalogue_dir: str | None = None,
) -> pathlib.Path:
    from experiments.simulation.objects.catalogues import FOLDER
    from experiments.simulation.scenes.build import ScenesConfig, build_scenes

    config = ScenesConfig(split, num_scenes, tuple(sources), seed)
    place = catalogue_dir or FOLDER
    return build_scenes(config, data_dir, num_workers, catalogue_dir=place)


def _meshes(
    split: str, data_dir: _Place, num_workers: int | None, mesh_dir: str | None = None
) -> pathlib.Path:
    from experiments.simulation.meshes import build_meshes

    if mesh_dir is None or data_dir is None:
        remedy = "name the folder of meshes with --mesh_dir, and --output_dir"
        raise InputError("meshes", "have no folder of their own", remedy)
    return build_meshes(mesh_dir, pathlib.Path(data_dir) / split, num_workers)


BUILDERS: Mapping[str, Callable[..., pathlib.Path]] = {
    "shapes": _shapes,
    "open": _open,
    "roboarm": _roboarm,
    "cells": _cells,
    "objects": _objects,
    "scenes": _scenes,
    "meshes": _meshes,
}
"""By split, folder for all splits, number of workers, and settings of their own."""


def settings_of(name: str) -> tuple[str, ...]:
    """What can be changed of a set that is built."""
    return tuple(inspect.signature(BUILDERS[name]).parameters)[3:]


def build_dataset(
    name: str,
    split: str,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    **settings: Any,
) -> pathlib.Path:
    """Builds what is missing of a set's split, and returns its folder.

    A name that is not in `BUILDERS`, or a missing package, raises InputError. Meshes go
    to the folder of the split, where they open as "packed".
    """
    builder = BUILDERS[choose("data set", name, BUILDERS)]
    for package in ("trimesh", "manifold3d", "embreex", "fpsample"):
        require(package, "data")
    return builder(split, data_dir, num_workers, **settings)


def build_if_missing(
    name: str,
    split: str,
    data_dir: str | os.PathLike | None = None,
    **settings: Any,
) -> None:
    """Builds a generated set's split, or goes on with what was broken off, unless one
    is finished there, of whatever settings.

    Sets that are not generated are left alone. `settings` as in `build_dataset`.
    """
    if name in GENERATED and digest_of(name, split, data_dir) is None:
        build_dataset(name, split, data_dir, **settings)
