"""Writes the shards that `prism_jax.data.shards` reads."""

import functools
import io
import json
import os
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Float32, UInt16

from experiments.simulation.building import build
from prism_jax.data import shards as stored
from prism_jax.data.shards import ARRAYS, FORMAT_VERSION, MAPS, NAMES, shard_file
from prism_jax.data.source import Example
from prism_jax.geometry.visibility import UNKNOWN, Visibility, nothing_known
from prism_jax.io.atomic import write_bytes

STEPS = 2**16 - 1  # of a box's longest side: what a coordinate is rounded to

Box = Float32[np.ndarray, "4"]
MakeObject = Callable[[int], Iterable[Example]]


def build_shards(
    folder: str | os.PathLike,
    content: Mapping[str, Any],
    shards: Sequence[Sequence[int]],
    make_object: MakeObject,
    num_workers: int | None = None,
    progress: bool = True,
    box: Box | None = None,
    maps: bool = False,
) -> pathlib.Path:
    """Builds what is missing of a folder of shards, each with these objects.

    `make_object` gives the views of one object, with clouds in farthest-point order and
    all of one size; views in a row that have the same complete cloud share it. A
    coordinate is rounded to 1 / `STEPS` of the longest side of cloud and views, or to
    the steps of `box`. With `maps` what the sensors know is kept too. All else is as in
    `building.build`.
    """
    folder = pathlib.Path(folder)
    return build(
        folder,
        {"format_version": FORMAT_VERSION, **content},
        [len(shard) for shard in shards],
        lambda number: is_written(folder, number, maps),
        functools.partial(_build_shard, folder, shards, make_object, box, maps),
        "object",
        num_workers,
        progress,
    )


def is_written(folder: pathlib.Path, number: int, maps: bool = False) -> bool:
    """Whether all files of a shard are there."""
    contents = (*ARRAYS, *(MAPS if maps else ()), NAMES)
    return all(shard_file(folder, number, content).exists() for content in contents)


def _build_shard(
    folder: pathlib.Path,
    shards: Sequence[Sequence[int]],
    make_object: MakeObject,
    box: Box | None,
    maps: bool,
    number: int,
) -> None:
    objects = (make_object(identity) for identity in shards[number])
    write_shard(folder, number, objects, box, maps)


def write_shard(
    folder: pathlib.Path,
    number: int,
    objects: Iterable[Iterable[Example]],
    box: Box | None = None,
    maps: bool = False,
) -> None:
    """Writes one shard of the views of these objects; as `build_shards` does."""
    columns: dict[str, list[Any]] = {
        name: [] for name in (*ARRAYS, *(MAPS if maps else ()))
    }
    names = []
    for position, examples in enumerate(objects):
        for views in _by_complete(examples):
            clouds = [views[0].complete, *(view.partial for view in views)]
            own = box_of(np.concatenate(clouds)) if box is None else box
            columns["complete"].append(quantised(clouds[0], own))
            columns["box"].append(own)
            for view in views:
                columns["partial"].append(quantised(view.partial, own))
                eye = np.full(3, np.nan) if view.eye is None else view.eye
                columns["eye"].append(np.asarray(eye, np.float32))
                row = len(columns["box"]) - 1, position
                columns["views"].append(np.array(row, np.int32))
                names.append([view.category, view.name, view.any_heading])
                if maps:
                    encoded = encode(view.visibility or nothing_known())
                    for name, row in zip(MAPS, encoded, strict=True):
                        columns[name].append(row)
    for name, rows in columns.items():
        write_array(folder, number, name, np.stack(rows))
    write_bytes(shard_file(folder, number, NAMES), json.dumps(names).encode())


def write_array(folder: pathlib.Path, number: int, name: str, array: Any) -> None:
    """Writes one array of a shard, whole or not at all."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    write_bytes(shard_file(folder, number, name), buffer.getvalue())


def _by_complete(views: Iterable[Any]) -> list[list[Any]]:
    """Views in a row that have the same complete cloud."""
    groups: list[list[Any]] = []
    for view in views:
        if groups and np.array_equal(groups[-1][0].complete, view.complete):
            groups[-1].append(view)
        else:
            groups.append([view])
    return groups


def box_of(points: Float[np.ndarray, "N 3"]) -> Box:
    """The lowest corner, and the size of a step."""
    lower = points.min(0).astype(np.float32)
    side = (points - lower).max() * (1 + 1e-6) or 1.0
    return np.append(lower, np.float32(side / STEPS))


def quantised(points: Float[np.ndarray, "N 3"], box: Box) -> UInt16[np.ndarray, "N 3"]:
    """The nearest steps from the lowest corner of a box; what lies outside is moved to
    its sides."""
    steps = np.round((points.astype(np.float64) - box[:3]) / box[3])
    return np.clip(steps, 0, STEPS).astype(np.uint16)


def encode(visibility: Visibility) -> tuple[stored.Pixels, stored.View]:
    """One map as it is stored. Its camera has no skew; known depths are positive."""
    camera = jax.tree.map(np.asarray, visibility.camera)
    state = np.asarray(visibility.state)
    depth = np.asarray(visibility.depth, np.float64)
    known = state != UNKNOWN
    near, far = (depth[known].min(), depth[known].max()) if known.any() else (1.0, 1.0)
    # What the reader has, so that the steps are the same.
    near, far = np.float32(near), np.float32(far)
    ratio = np.log(max(far / near, 1 + 1e-6))
    steps = np.log(np.where(known, depth, near) / near) / ratio * stored.DEPTH_STEPS
    steps = np.clip(np.rint(steps), 0, stored.DEPTH_STEPS).astype(np.uint16)
    focal_x, focal_y = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    middle = camera.intrinsics[:2, 2]
    pose = camera.rotation.ravel(), camera.translation
    view = np.concatenate([*pose, [focal_x, focal_y], middle, [near, far]])
    return (state.astype(np.uint16) << stored.DEPTH_BITS) | steps, view.astype(
        np.float32
    )
