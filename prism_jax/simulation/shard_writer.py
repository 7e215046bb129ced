"""Writes the shards that `prism_jax.data.shards` reads."""

import functools
import io
import json
import os
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt16

from prism_jax.data.maps import encode
from prism_jax.data.shards import ARRAYS, FORMAT_VERSION, MAPS, NAMES, shard_file
from prism_jax.data.source import Example
from prism_jax.geometry.visibility import nothing_known
from prism_jax.io.atomic import write_bytes
from prism_jax.simulation.building import build

STEPS = 2**16 - 1
"""Of a box's longest side: what a coordinate is rounded to."""

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

    `make_object` is pickled for the workers. It gives the views of one object, with
    clouds in farthest-point order and all of one size; views in a row that have the
    same complete cloud share it. A coordinate is rounded to 1 / `STEPS` of the longest
    side of cloud and views, or to the steps of `box` if it is given. With `maps` what
    the sensors know is kept too, in files of its own; a view that does not say knows
    nothing. All else is as in `building.build`.
    """
    folder = pathlib.Path(folder)
    arrays = (*ARRAYS, *MAPS) if maps else ARRAYS
    return build(
        folder,
        {"format_version": FORMAT_VERSION, **content},
        [len(shard) for shard in shards],
        lambda number: all(
            shard_file(folder, number, name).exists() for name in (*arrays, NAMES)
        ),
        functools.partial(_write_shard, folder, shards, make_object, box, arrays),
        "object",
        num_workers,
        progress,
    )


def _write_shard(
    folder: pathlib.Path,
    shards: Sequence[Sequence[int]],
    make_object: MakeObject,
    box: Box | None,
    arrays: Sequence[str],
    number: int,
) -> None:
    columns: dict[str, list[Any]] = {name: [] for name in arrays}
    names = []
    for position, identity in enumerate(shards[number]):
        for views in _by_complete(make_object(identity)):
            clouds = [views[0].complete, *(view.partial for view in views)]
            own = _box(np.concatenate(clouds)) if box is None else box
            columns["complete"].append(quantised(clouds[0], own))
            columns["box"].append(own)
            for view in views:
                columns["partial"].append(quantised(view.partial, own))
                eye = np.full(3, np.nan) if view.eye is None else view.eye
                columns["eye"].append(np.asarray(eye, np.float32))
                row = len(columns["box"]) - 1, position
                columns["views"].append(np.array(row, np.int32))
                names.append([view.category, view.name, view.any_heading])
                if "map" in columns:
                    known = encode(view.visibility or nothing_known())
                    for name, row in zip(MAPS, known, strict=True):
                        columns[name].append(row)
    for name, rows in columns.items():
        buffer = io.BytesIO()
        np.save(buffer, np.stack(rows), allow_pickle=False)
        write_bytes(shard_file(folder, number, name), buffer.getvalue())
    write_bytes(shard_file(folder, number, NAMES), json.dumps(names).encode())


def _by_complete(views: Iterable[Any]) -> list[list[Any]]:
    """Views in a row that have the same complete cloud."""
    groups: list[list[Any]] = []
    for view in views:
        if groups and np.array_equal(groups[-1][0].complete, view.complete):
            groups[-1].append(view)
        else:
            groups.append([view])
    return groups


def _box(points: Float[np.ndarray, "N 3"]) -> Box:
    """The lowest corner, and the size of a step."""
    lower = points.min(0).astype(np.float32)
    side = (points - lower).max() * (1 + 1e-6) or 1.0
    return np.append(lower, np.float32(side / STEPS))


def quantised(points: Float[np.ndarray, "N 3"], box: Box) -> UInt16[np.ndarray, "N 3"]:
    """The nearest steps from the lowest corner of a box; what lies outside is moved to
    its sides."""
    steps = np.round((points.astype(np.float64) - box[:3]) / box[3])
    return np.clip(steps, 0, STEPS).astype(np.uint16)
