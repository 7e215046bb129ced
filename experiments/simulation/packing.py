"""Packs examples of any sources, put in farthest-point order once, into shards; among
them any folder of meshes (OBJ, OFF, PLY, STL, GLB) and of complete clouds (all that
`prism_jax.io` reads), however deep they lie.
"""

import dataclasses
import functools
import hashlib
import io
import os
import pathlib
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from experiments.simulation.partials import make_partial, random_viewpoint
from experiments.simulation.raycast import Scene
from experiments.simulation.shard_writer import build_shards
from prism_jax.data.manifest import files_digest, hash_files
from prism_jax.data.ordering import first_points
from prism_jax.data.source import Example, Source, sound_cloud
from prism_jax.io.clouds import READERS, read_points
from prism_jax.io.errors import InputError
from prism_jax.io.files import read_bytes

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

    `digests` (`manifest.content_digest`) tell that a folder was begun with the same
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


MESHES = (".obj", ".off", ".ply", ".stl", ".glb")
SUFFIXES = (*MESHES, *(suffix for suffix in READERS if suffix not in MESHES))
FACES = re.compile(rb"\belement face [1-9]")


class Meshes:
    """Meshes as clouds of their surface, and complete clouds, each with one simulated
    partial view; of a cloud, the points that others do not hide (`unhidden`).

    A mesh is `normalised`; its axes stay as they are, so that the simulated camera,
    which takes z for up, sees a mesh with y up from its side. The complete cloud is
    uniform on the whole surface, inner faces included. Points and view are drawn with a
    seed made of the path below `root`: another place or order of the folder changes
    nothing. The category is the first folder below `root`, "mesh" for files that lie in
    none.
    """

    def __init__(
        self,
        root: str | os.PathLike,
        num_points: int = 16384,
        partial_points: int = 2048,
    ):
        self.root = pathlib.Path(root)
        self.num_points = num_points
        self.partial_points = partial_points
        below = [path.relative_to(self.root) for path in _find(self.root)]
        self._files = [
            (path.as_posix(), path.parts[0] if len(path.parts) > 1 else "mesh")
            for path in below
        ]
        self.categories = tuple(sorted({category for _, category in self._files}))

    @property
    def objects(self) -> Int[np.ndarray, " N"]:
        """Each mesh is one."""
        return np.arange(len(self))

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> Example:
        name, category = self._files[range(len(self))[index]]
        path = self.root / name
        kind, content = path.suffix.lower(), read_bytes(path)
        digest = hashlib.sha256(name.encode()).digest()
        rng = np.random.default_rng(int.from_bytes(digest[:8], "little"))
        faces = kind in MESHES and (kind != ".ply" or FACES.search(content[:4096]))
        if not faces:
            points = rng.permutation(read_points(path))[: self.num_points]
            complete, eye = _in_unit_box(points.astype(float)), random_viewpoint(rng)
            partial = unhidden(complete, eye)
        else:
            mesh = normalised(parse_mesh(content, kind[1:], path))
            surface = trimesh.sample.sample_surface(mesh, self.num_points, seed=rng)[0]
            complete = np.asarray(surface, np.float64)
            partial, eye = make_partial(
                "self_occlusion", Scene(mesh), complete, rng, self.partial_points
            )
        return Example(
            sound_cloud(complete, path),
            sound_cloud(partial, path),
            eye.astype(np.float32),
            category,
            name,
        )


def build_meshes(
    root: str | os.PathLike,
    folder: str | os.PathLike,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Packs all meshes below `root` into `folder`, which opens as a split of "packed".
    A mesh that cannot be read raises InputError."""
    source = Meshes(root)
    digests = {"meshes": files_digest(hash_files(source.root))}
    config = PackConfig(source.partial_points, source.num_points)
    return pack({"meshes": source}, folder, config, num_workers, progress, digests)


def _find(base: pathlib.Path) -> list[pathlib.Path]:
    """All files of meshes and clouds below a folder, in the order of their paths."""
    if not base.is_dir():
        raise InputError(base, "no such folder", "give a folder of meshes or clouds")
    found = [
        pathlib.Path(folder, name)
        for folder, _, names in os.walk(base)
        for name in names
        if pathlib.Path(name).suffix.lower() in SUFFIXES
    ]
    if not found:
        fault = f"no meshes or clouds ({' '.join(SUFFIXES)})"
        raise InputError(base, fault, "give a folder of them")
    return sorted(found)


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
    """The given mesh, moved and scaled: its box is centred at the origin, the longest
    side spans [-1, 1]."""
    mesh.vertices = _in_unit_box(np.asarray(mesh.vertices), mesh.bounds)
    return mesh


def _in_unit_box(points: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
    lower, upper = (points.min(0), points.max(0)) if bounds is None else bounds
    return (points - (lower + upper) / 2) / ((upper - lower).max() / 2)


def unhidden(
    points: Float[np.ndarray, "M 3"], eye: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "N 3"]:
    """Points of a surface that is seen from `eye`, by the operator of Katz et al.,
    Direct visibility of point sets (2007): reflected in a large sphere around the eye,
    these are the corners of the convex hull."""
    rays = points - eye
    ranges = np.linalg.norm(rays, axis=1, keepdims=True)
    reflected = rays * (2 * 100 * ranges.max() / ranges - 1)
    corners = ConvexHull(np.concatenate([reflected, np.zeros((1, 3))])).vertices
    return points[np.sort(corners[corners < len(points)])]
