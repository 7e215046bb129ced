"""Packs examples of any sources, put in farthest-point order once, into shards."""

import dataclasses
import functools
import io
import os
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import trimesh

from experiments.simulation.shard_writer import build_shards
from prism_jax.data.ordering import first_points
from prism_jax.data.source import Example, Source
from prism_jax.io.errors import InputError

SHARD_EXAMPLES = 100  # a shard is full once it has as many

_Group = tuple[str, list[int]]  # a source's name, and its rows that show one object


@dataclasses.dataclass(frozen=True)
class PackConfig:
    """Points kept of each cloud, and examples taken of each source."""

    num_partial: int = 2048  # farthest points; a smaller cloud is repeated
    num_complete: int = 16_384
    limit: int = 0  # the most of a source, evenly spaced through it; 0 for all


def pack(
    sources: Mapping[str, Source],
    folder: str | os.PathLike,
    config: PackConfig = PackConfig(),
    num_workers: int | None = None,
    progress: bool = True,
    digests: Mapping[str, str | None] | None = None,
) -> pathlib.Path:
    """Packs sources, by the names that tell them apart, one after the other.

    `digests` (`splits.content_digest`) tell that a folder was begun with the same
    sources. What sensors know is kept if the first example of any source has it. An
    example without a partial or a complete cloud raises InputError.
    """
    groups = [group for name in sources for group in _groups(name, sources, config)]
    content = {
        "generator": "prism_jax packed",
        **dataclasses.asdict(config),
        "sources": {name: len(source) for name, source in sources.items()},
        "order": list(sources),
        "digests": dict(digests or {}),
        "categories": sorted({c for s in sources.values() for c in s.categories}),
    }
    make_object = functools.partial(_examples, dict(sources), groups, config)
    shards = _shards([len(rows) for _, rows in groups])
    maps = any(source[0].visibility is not None for source in sources.values())
    return build_shards(
        folder, content, shards, make_object, num_workers, progress, maps=maps
    )


def _groups(
    name: str, sources: Mapping[str, Source], config: PackConfig
) -> list[_Group]:
    """The rows that are taken of a source, object by object."""
    source = sources[name]
    rows = np.arange(len(source))
    if config.limit and len(rows) > config.limit:
        rows = np.linspace(0, len(rows) - 1, config.limit).astype(int)
    edges = np.flatnonzero(np.diff(source.objects[rows])) + 1
    return [(name, part.tolist()) for part in np.split(rows, edges)]


def _shards(sizes: Sequence[int]) -> list[list[int]]:
    """Objects in a row, until they are enough examples for a shard."""
    shards: list[list[int]] = [[]]
    held = 0
    for number, size in enumerate(sizes):
        if held >= SHARD_EXAMPLES:
            shards.append([])
            held = 0
        shards[-1].append(number)
        held += size
    return shards


def _examples(
    sources: Mapping[str, Source],
    groups: Sequence[_Group],
    config: PackConfig,
    number: int,
) -> Iterator[Example]:
    """The views of one object, as they are stored."""
    name, rows = groups[number]
    given: Any = None
    ordered: Any = None
    for row in rows:
        example = sources[name][row]
        if example.partial is None or example.complete is None:
            fault = "no partial or no complete cloud"
            remedy = "pack a source whose examples have both clouds"
            raise InputError(example.name, fault, remedy)
        if ordered is None or not np.array_equal(given, example.complete):
            given = example.complete
            ordered = first_points(given, config.num_complete, example.ordered)
        yield example._replace(
            complete=ordered,
            partial=first_points(example.partial, config.num_partial, example.ordered),
            name=f"{name}/{example.name}",
            ordered=True,
        )


def parse_mesh(
    data: bytes, file_type: str, subject: str | os.PathLike
) -> trimesh.Trimesh:
    """The triangles of a file's bytes as one mesh, without stray vertices.

    What cannot be read, has no area or is not finite raises InputError about the
    subject.
    """
    remedy = "export it again as a triangle mesh, or remove it"
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=file_type, process=False)
        mesh.remove_unreferenced_vertices()
        sound = len(mesh.faces) > 0 and bool(np.isfinite(mesh.triangles).all())
    except Exception as error:  # trimesh's parsers raise of every kind
        fault = f"not a readable mesh ({error})"
        raise InputError(subject, fault, remedy) from None
    if not sound or not mesh.area > 0:
        raise InputError(subject, "no surface, or not finite", remedy)
    return mesh


def normalised(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The given mesh, `in_unit_box`."""
    mesh.vertices = in_unit_box(np.asarray(mesh.vertices), mesh.bounds)
    return mesh


def in_unit_box(points: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
    """Moved and scaled: the box, by default the points', is centred at the origin, and
    its longest side spans [-1, 1]."""
    lower, upper = (points.min(0), points.max(0)) if bounds is None else bounds
    return (points - (lower + upper) / 2) / ((upper - lower).max() / 2)
