"""Builds the data set `cells`: robot cells of many layouts, a few frames of each."""

import dataclasses
import functools
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np

from experiments.simulation.configs import SetConfig, shards_of
from experiments.simulation.roboarm.cell_views import CellView, make_cell_view
from experiments.simulation.roboarm.models import CELL_ARMS, ArmModel, urdf_path
from experiments.simulation.roboarm.workcells import Workcell, make_workcell
from experiments.simulation.sensors import L515Config
from experiments.simulation.shard_writer import build_shards
from experiments.simulation.views import PARTIAL_POINTS, SURFACE_POINTS
from prism_jax.data.datasets import CELLS_VERSION, folder_of
from prism_jax.data.source import Example
from prism_jax.io.errors import InputError

SHARD_CELLS = 25
MAX_DRAWS = 60
_L515 = L515Config()


@dataclasses.dataclass(frozen=True)
class CellsConfig(SetConfig):
    """What a split of the cells is made of: cell i has arm `i % len(arms)`."""

    SIZES: ClassVar = {"train": {"num_cells": 4000}, "validation": {"num_cells": 100}}

    split: str = "train"
    num_cells: int = 0
    num_frames: int = 2  # poses of the arm in each cell, seen from one place
    seed: int = 0  # of the whole set
    width: int = 640  # pixels of the depth camera
    height: int = 480
    # How often a link, a tool with its hoses, or all fixtures mirror the beams.
    glossy_share: float = 0.15
    # How often a partial cloud is cut off by more than the image.
    truncated_share: float = 0.2
    sensor: L515Config = _L515
    partial_points: int = PARTIAL_POINTS
    complete_points: int = SURFACE_POINTS


def build_cells(
    config: CellsConfig,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
    arms: Sequence[ArmModel] | None = None,
) -> pathlib.Path:
    """Builds what is missing of a split and returns its folder.

    The arms are by default the split's own; one that is not installed raises
    InputError.
    """
    arms = tuple(CELL_ARMS[config.split] if arms is None else arms)
    for model in arms:
        urdf_path(model)
    content = config.content(
        "cells",
        CELLS_VERSION,
        categories=[model.name for model in arms],
        arms=[dataclasses.asdict(model) for model in arms],
    )
    return build_shards(
        folder_of("cells", config.split, data_dir),
        content,
        shards_of(config.num_cells, SHARD_CELLS),
        functools.partial(_examples, config, arms),
        num_workers,
        progress,
        maps=True,
    )


def cell_views(
    config: CellsConfig, index: int, arms: Sequence[ArmModel] | None = None
) -> tuple[Workcell, list[CellView]]:
    """A cell and its frames: a pure function of the arguments. A draw of which too
    little is seen is drawn again."""
    arms = CELL_ARMS[config.split] if arms is None else arms
    model, split = arms[index % len(arms)], list(config.SIZES).index(config.split)
    count, size = config.num_frames, (config.height, config.width)
    points = config.partial_points, config.complete_points
    given = config.sensor, config.truncated_share, *points
    for attempt in range(MAX_DRAWS):
        rng = np.random.default_rng((config.seed, split, index, attempt))
        try:
            cell = make_workcell(model, count, rng, size, config.glossy_share)
            return cell, [make_cell_view(cell, n, rng, *given) for n in range(count)]
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            fault = str(error)
    raise ValueError(f"no cell of {model.name} in {MAX_DRAWS} draws: {fault}")


def _examples(
    config: CellsConfig, arms: Sequence[ArmModel], index: int
) -> Iterator[Example]:
    cell, views = cell_views(config, index, arms)
    for number, view in enumerate(views):
        kind = f"{cell.mount.kind}{'+truncated' if view.cut else ''}"
        yield Example(
            view.complete,
            view.partial,
            view.eye,
            cell.arm.model.name,
            f"{index:06d}/{number:02d}/{kind}",
            ordered=True,
            any_heading=True,
            visibility=view.visibility,
        )
