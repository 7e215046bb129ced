"""Which of the catalogues' models make up a split, and which are left out, and why."""

import dataclasses
import hashlib
import os
from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Float64, UInt8
from tqdm import tqdm

from experiments.simulation.objects.catalogues import (
    CATALOGUES,
    FOLDER,
    NO_OBJECTS,
    Model,
    category_of,
    read_installed,
)
from experiments.simulation.packing import normalised
from prism_jax.io.errors import InputError

MIN_TRIANGLES = 12  # as many as a box has
MIN_THICKNESS = 0.01  # thinnest side in longest ones: less is a picture or a rug
MIN_SLAB = 0.1  # thinnest side in middle ones: less is a slab
MAX_OVERLAP = 0.8
"""Share of the cells that either of two models is in: if more have both in them, and no
side of theirs differs by `MAX_SIDES` or more, they look alike."""
MAX_SIDES = 0.05
ALIKE = "looks like"
CELLS = 24  # along each side of a model's box
SAMPLES = 20_000
ROUNDING = 200  # steps of a unit to which corners are rounded for a mesh's digest


@dataclasses.dataclass(frozen=True)
class Survey:
    """The models of one or more splits."""

    versions: dict[str, str]  # of the catalogues, by name
    models: list[tuple[Model, str]]  # those taken, with the digests of their meshes
    left_out: dict[str, str]  # why the others are not, by identity


def survey(
    splits: Sequence[str], folder: str | os.PathLike = FOLDER, progress: bool = False
) -> Survey:
    """Loads all models of some splits, and those of the catalogues before theirs.

    A model is left out if its catalogue or its title says that it is no object, if its
    mesh cannot be read or is too thin, or if it looks like one that was taken before,
    of whichever split. A catalogue that is not installed raises InputError.
    """
    wanted = [known.split in splits for known in CATALOGUES]
    needed = CATALOGUES[: len(wanted) - wanted[::-1].index(True)]
    read = [(known, *read_installed(known, folder)) for known in needed]
    told = {known.name: version for known, version, _ in read if known.split in splits}
    result, taken = Survey(told, [], {}), _Taken()
    models = [model for _, _, found in read for model in found]
    for model in tqdm(models, "checked", unit="model", disable=not progress):
        mesh, reason = _checked(model)
        if mesh is not None:
            reason = taken.add(model, mesh)
        if model.catalogue not in told:
            continue
        if reason is not None:
            result.left_out[model.identity] = reason
        elif mesh is not None:
            result.models.append((model, digest_of(mesh)))
    return result


class _Taken:
    """Models that were taken, to find those that look like one of them."""

    def __init__(self):
        self._models: list[Model] = []
        self._cells = np.zeros((0, CELLS**3 // 8), np.uint8)
        self._sides = np.zeros((0, 3))

    def add(self, model: Model, mesh: trimesh.Trimesh) -> str | None:
        """Adds a model and its normalised mesh, or returns what it looks like."""
        cells, sides = occupied_cells(mesh), mesh.extents
        alike = (overlaps(cells, self._cells) > MAX_OVERLAP) & (
            np.abs(self._sides - sides).max(axis=1, initial=0) < MAX_SIDES
        )
        if alike.any():
            return f"{ALIKE} {self._models[int(alike.argmax())].identity}"
        self._models.append(model)
        self._cells = np.concatenate([self._cells, cells[None]])
        self._sides = np.concatenate([self._sides, sides[None]])
        return None


def _checked(model: Model) -> tuple[trimesh.Trimesh | None, str | None]:
    """A model's mesh, normalised; or None, and why it is left out by itself."""
    reason = model.fault or NO_OBJECTS.get(category_of(model.title))
    if reason:
        return None, reason
    try:
        mesh = normalised(model.load())
    except InputError:
        return None, "cannot be read, or has no surface"
    reason = fault_of(mesh)
    return (None, reason) if reason else (mesh, None)


def fault_of(mesh: trimesh.Trimesh) -> str | None:
    """Why a mesh is nothing that has a back to complete; None if it is."""
    thin, middle, long = np.sort(mesh.extents)
    if len(mesh.faces) < MIN_TRIANGLES:
        return f"has {len(mesh.faces)} triangles"
    if thin < MIN_THICKNESS * long:
        return "is flat"
    return "is a slab" if thin < MIN_SLAB * middle else None


def digest_of(mesh: trimesh.Trimesh) -> str:
    """Twelve digits that tell a normalised mesh's corners from all others, whatever
    their order and colours."""
    corners = np.unique(np.round(ROUNDING * mesh.vertices).astype(np.int32), axis=0)
    return hashlib.sha256(corners.astype("<i4").tobytes()).hexdigest()[:12]


def occupied_cells(mesh: trimesh.Trimesh) -> UInt8[np.ndarray, " B"]:
    """Which cells of its own box a mesh's surface is in, eight to a byte."""
    corners = (mesh.vertices - mesh.bounds[0]) / mesh.extents
    cube = trimesh.Trimesh(corners, mesh.faces, process=False)
    points = np.asarray(trimesh.sample.sample_surface(cube, SAMPLES, seed=0)[0])
    cells = np.clip(points * CELLS, 0, CELLS - 1).astype(int)
    occupied = np.zeros((CELLS, CELLS, CELLS), bool)
    occupied[tuple(cells.T)] = True
    return np.packbits(occupied)


def overlaps(
    cells: UInt8[np.ndarray, " B"], others: UInt8[np.ndarray, "N B"]
) -> Float64[np.ndarray, " N"]:
    """Cells that both of two have, in those that either has, for each of others."""
    both = np.bitwise_count(cells & others).sum(axis=1)
    return both / np.bitwise_count(cells | others).sum(axis=1)
