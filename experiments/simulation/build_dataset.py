"""Builds the data sets that are made on the machine, by the name that flags use."""

import os
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

from experiments.splits import digest_of
from prism_jax.data.datasets import DATASETS, folder_of
from prism_jax.io.errors import InputError, choose, require

_Place = str | os.PathLike | None


def _shapes(split: str, data_dir: _Place, num_workers: int | None, **settings: Any):
    from experiments.simulation.shapes.build import ShapesConfig, build_shapes

    return build_shapes(ShapesConfig(split, **settings), data_dir, num_workers)


def _open(split: str, data_dir: _Place, num_workers: int | None, **settings: Any):
    from experiments.simulation.open_shapes.build import OpenConfig
    from experiments.simulation.shapes.build import build_shapes

    return build_shapes(OpenConfig(split, **settings), data_dir, num_workers)


def _roboarm(split: str, data_dir: _Place, num_workers: int | None, **settings: Any):
    from experiments.simulation.roboarm.build import build_roboarm
    from experiments.simulation.roboarm.models import own_arm

    folder = folder_of("roboarm", split, data_dir)
    arms = [own_arm(path) for path in settings.pop("urdf", ())] or None
    return build_roboarm(split, folder, num_workers=num_workers, arms=arms, **settings)


def _cells(split: str, data_dir: _Place, num_workers: int | None, **settings: Any):
    from experiments.simulation.roboarm.cells import CellsConfig, build_cells

    return build_cells(CellsConfig(split, **settings), data_dir, num_workers)


def _objects(split: str, data_dir: _Place, num_workers: int | None, **settings: Any):
    from experiments.simulation.objects.build import ObjectsConfig, build_objects
    from experiments.simulation.objects.catalogues import FOLDER

    place = data_dir, num_workers, True, settings.pop("catalogue_dir", FOLDER)
    return build_objects(ObjectsConfig(split, **settings), *place)


def _scenes(split: str, data_dir: _Place, num_workers: int | None, **settings: Any):
    from experiments.simulation.objects.catalogues import FOLDER
    from experiments.simulation.scenes.build import ScenesConfig, build_scenes

    if "sources" in settings:
        settings["sources"] = tuple(settings["sources"])
    place = data_dir, num_workers, True, settings.pop("catalogue_dir", FOLDER)
    return build_scenes(ScenesConfig(split, **settings), *place)


def _meshes(
    split: str, data_dir: _Place, num_workers: int | None, mesh_dir: str | None = None
):
    from experiments.own_models import build_meshes

    if mesh_dir is None or data_dir is None:
        remedy = "set --mesh_dir to the folder of meshes, and --output_dir"
        raise InputError("meshes", "no folder given", remedy)
    return build_meshes(mesh_dir, pathlib.Path(data_dir) / split, num_workers)


_VIEWS = ("num_views", "partial", "seed")
_BUILDERS: Mapping[str, tuple[Callable[..., pathlib.Path], tuple[str, ...]]] = {
    "shapes": (_shapes, ("num_shapes", *_VIEWS)),
    "open": (_open, ("num_shapes", *_VIEWS)),
    "roboarm": (_roboarm, ("num_sequences", "num_frames", "seed", "urdf")),
    "cells": (_cells, ("num_cells", "num_frames", "seed")),
    "objects": (_objects, (*_VIEWS, "catalogue_dir")),
    "scenes": (_scenes, ("num_scenes", "sources", "seed", "catalogue_dir")),
    "meshes": (_meshes, ("mesh_dir",)),
}
BUILDERS = tuple(_BUILDERS)  # names of what can be built


def settings_of(name: str) -> tuple[str, ...]:
    """What can be changed of a set that is built."""
    return _BUILDERS[name][1]


def build_dataset(
    name: str,
    split: str,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    **settings: Any,
) -> pathlib.Path:
    """Builds what is missing of a set's split, and returns its folder.

    A name that is not in `BUILDERS`, or a missing package, raises InputError.
    """
    builder, _ = _BUILDERS[choose("data set", name, BUILDERS)]
    for package in ("trimesh", "manifold3d", "embreex", "fpsample"):
        require(package, "data")
    return builder(split, data_dir, num_workers, **settings)


def build_if_missing(
    name: str, split: str, data_dir: str | os.PathLike | None = None, **settings: Any
) -> None:
    """Builds a generated set's split, or goes on with what was broken off, unless one
    is finished there, of whatever settings. Other sets are left alone."""
    if DATASETS[name].generated and digest_of(name, split, data_dir) is None:
        build_dataset(name, split, data_dir, **settings)
