"""Examples of any sources, ordered once and quantised, in shards.

What a training reads over and over: clouds in farthest-point order, so that nothing is
sampled again, 16 bits a coordinate, memory-mapped, and small enough to be carried to
another machine. Several sources packed together are a mixture.
"""

import dataclasses
import functools
import io
import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, UInt16

from prism_jax.data import builds
from prism_jax.data.ordering import first_points
from prism_jax.data.source import Example, Source
from prism_jax.io.atomic import write_bytes
from prism_jax.io.errors import InputError

GENERATOR_VERSION = 2
SHARD_EXAMPLES = 100

_ARRAYS = ("partial", "complete", "box", "eye")
_STEPS = 2**16 - 1
"""Of a box's longest side: what a coordinate is rounded to."""


@dataclasses.dataclass(frozen=True)
class PackConfig:
    """Points kept of each cloud, and examples taken of each source.

    Attributes:
      num_partial, num_complete: farthest points; a smaller cloud is repeated.
      limit: the most examples of a source, evenly spaced through it; 0 for all.
    """

    num_partial: int = 2048
    num_complete: int = 16_384
    limit: int = 0


def pack(
    sources: Mapping[str, Source],
    folder: str | os.PathLike,
    config: PackConfig = PackConfig(),
    num_workers: int | None = None,
    progress: bool = True,
    digests: Mapping[str, str | None] | None = None,
) -> pathlib.Path:
    """Packs sources, by the names that tell them apart, one after the other.

    `digests` (`builds.content_digest`), where given, tell that a folder was begun with
    the same sources. An example without a partial or a complete cloud raises
    InputError. The bytes do not depend on `num_workers` (`builds.build`).
    """
    rows = [
        (name, int(row))
        for name, source in sources.items()
        for row in _chosen(source, config.limit)
    ]
    content = {
        "generator": "prism_jax packed",
        "generator_version": GENERATOR_VERSION,
        **dataclasses.asdict(config),
        "sources": {name: len(source) for name, source in sources.items()},
        "order": list(sources),
        "digests": dict(digests or {}),
        "categories": sorted({c for s in sources.values() for c in s.categories}),
        "num_examples": len(rows),
        "shard_examples": SHARD_EXAMPLES,
    }
    folder = pathlib.Path(folder)
    shards = [
        rows[start : start + SHARD_EXAMPLES]
        for start in range(0, len(rows), SHARD_EXAMPLES)
    ]
    return builds.build(
        folder,
        content,
        [len(shard) for shard in shards],
        lambda number: all(
            path.exists()
            for path in (
                *(_file(folder, number, name) for name in _ARRAYS),
                _names(folder, number),
            )
        ),
        functools.partial(_build_shard, dict(sources), shards, config, folder),
        "example",
        num_workers,
        progress,
    )


class Packed:
    """A packed folder as a `Source`. One that is missing, unfinished or damaged raises
    InputError."""

    def __init__(self, root: str | os.PathLike):
        self.root = pathlib.Path(root)
        remedy = "pack it: experiments.pack"
        manifest = builds.read_manifest(self.root, remedy, GENERATOR_VERSION)
        builds.verify(self.root, manifest["files"], "delete it and pack again")
        self.categories = tuple(manifest["categories"])
        self._count = manifest["num_examples"]
        self._shard_examples = manifest["shard_examples"]
        self._shards: dict[int, tuple[dict[str, np.ndarray], list[list[Any]]]] = {}

    @property
    def objects(self) -> Int[np.ndarray, " N"]:
        """Each example counts as an object of its own: which show one is not packed."""
        return np.arange(self._count)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Example:
        number, row = divmod(range(len(self))[index], self._shard_examples)
        arrays, names = self._shard(number)
        partial, complete, box, eye = (arrays[name][row] for name in _ARRAYS)
        category, name, any_heading = names[row]
        return Example(
            _restored(complete, box),
            _restored(partial, box),
            None if np.isnan(eye).any() else np.array(eye),
            category,
            name,
            ordered=True,
            any_heading=any_heading,
        )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_shards": {}}

    def _shard(self, number: int) -> tuple[dict[str, np.ndarray], list[list[Any]]]:
        """A shard's arrays, mapped into memory once, and what else is known of its
        examples."""
        if number not in self._shards:
            arrays = {
                name: np.load(
                    _file(self.root, number, name), mmap_mode="r", allow_pickle=False
                )
                for name in _ARRAYS
            }
            names = json.loads(_names(self.root, number).read_text())
            self._shards[number] = arrays, names
        return self._shards[number]


def _chosen(source: Source, limit: int) -> Sequence[int]:
    count = len(source)
    if not limit or count <= limit:
        return range(count)
    return np.linspace(0, count - 1, limit).astype(int).tolist()


def _build_shard(
    sources: Mapping[str, Source],
    shards: Sequence[Sequence[tuple[str, int]]],
    config: PackConfig,
    folder: pathlib.Path,
    number: int,
) -> None:
    columns: dict[str, list[np.ndarray]] = {name: [] for name in _ARRAYS}
    names = []
    for source, row in shards[number]:
        example = sources[source][row]
        if example.partial is None or example.complete is None:
            remedy = "pack a source whose examples have both clouds"
            raise InputError(
                example.name, "has no partial or no complete cloud", remedy
            )
        partial = first_points(example.partial, config.num_partial, example.ordered)
        complete = first_points(example.complete, config.num_complete, example.ordered)
        box = _box(np.concatenate([partial, complete]))
        eye = np.full(3, np.nan) if example.eye is None else example.eye
        packed = (_quantised(partial, box), _quantised(complete, box), box, eye)
        for name, array in zip(_ARRAYS, packed, strict=True):
            columns[name].append(array)
        name = f"{source}/{example.name}"
        names.append([example.category, name, example.any_heading])
    for name, rows in columns.items():
        buffer = io.BytesIO()
        array = np.stack(rows)
        array = array.astype(np.float32) if name in ("box", "eye") else array
        np.save(buffer, array, allow_pickle=False)
        write_bytes(_file(folder, number, name), buffer.getvalue())
    write_bytes(_names(folder, number), json.dumps(names).encode())


def _box(points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "4"]:
    """The lowest corner, and the size of a step."""
    lower = points.min(0).astype(np.float32)
    side = (points - lower).max() * (1 + 1e-6) or 1.0
    return np.append(lower, np.float32(side / _STEPS))


def _quantised(
    points: Float[np.ndarray, "N 3"], box: Float32[np.ndarray, "4"]
) -> UInt16[np.ndarray, "N 3"]:
    steps = np.round((points.astype(np.float64) - box[:3]) / box[3])
    return np.clip(steps, 0, _STEPS).astype(np.uint16)


def _restored(
    steps: UInt16[np.ndarray, "N 3"], box: Float32[np.ndarray, "4"]
) -> Float32[np.ndarray, "N 3"]:
    return np.asarray(steps.astype(np.float32) * box[3] + box[:3])


def _file(folder: pathlib.Path, number: int, name: str) -> pathlib.Path:
    return folder / f"shard-{number:05d}.{name}.npy"


def _names(folder: pathlib.Path, number: int) -> pathlib.Path:
    """Written last: a shard is there once its names are."""
    return folder / f"shard-{number:05d}.names.json"
