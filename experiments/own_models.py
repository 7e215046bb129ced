"""Any folder of meshes (OBJ, OFF, PLY, STL, GLB) and of complete clouds (all that
`prism_jax.io` reads), however deep they lie, as a data set."""

import hashlib
import os
import pathlib
import re

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from experiments.simulation.packing import (
    PackConfig,
    in_unit_box,
    normalised,
    pack,
    parse_mesh,
)
from experiments.simulation.partials import make_partial, random_viewpoint
from experiments.simulation.raycast import Scene
from experiments.splits import files_digest
from prism_jax.data.manifest import hash_files
from prism_jax.data.source import Example, sound_cloud
from prism_jax.io.clouds import READERS, read_points
from prism_jax.io.errors import InputError
from prism_jax.io.files import read_bytes

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
            complete, eye = in_unit_box(points.astype(float)), random_viewpoint(rng)
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
