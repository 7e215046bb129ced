"""What the published layouts share: lists of models, folders of files, checked clouds.

A set that is not laid out as published is refused before the first item is read. Each
folder is listed once, since a network drive answers 30,000 listings far sooner than
230,000 questions for single files.
"""

import os
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int

from prism_jax.io.arrays import read_npy
from prism_jax.io.errors import InputError, StrPath, unreadable
from prism_jax.io.files import read_bytes

_SHOWN = 3
_TAKE_LIST = "use the list published with the data set"
_COPY_AGAIN = "copy this file again from the data set"


class Model(NamedTuple):
    """One object of a list: its category's name, its folder and its own id."""

    category: str
    folder: str
    id: str


class ListedSource:
    """The objects of a list, each seen in `views` partial clouds. Index i is view `i %
    views` of object `i // views`, in the list's order. Subclasses add `__getitem__`. It
    holds nothing but strings, so it can be pickled."""

    def __init__(self, root: pathlib.Path, models: Sequence[Model], views: int):
        self.root = root
        self.models = tuple(models)
        self.views = views
        self.categories = tuple(sorted({model.category for model in models}))

    @property
    def objects(self) -> Int[np.ndarray, " N"]:
        """Every object as often as it was seen."""
        return np.repeat(np.arange(len(self.models)), self.views)

    def __len__(self) -> int:
        return len(self.models) * self.views

    def locate(self, index: int) -> tuple[Model, int]:
        """The object and the view of an item; IndexError outside the range."""
        number, view = divmod(range(len(self))[index], self.views)
        return self.models[number], view


def read_list(path: StrPath, pattern: str, form: str) -> list[tuple[str, ...]]:
    """The groups of a pattern for each line of a list file that is not blank. A list
    that is missing or empty, or that has a line of another form or the same line twice,
    raises InputError."""
    lines = [line.strip() for line in _read_text(path).splitlines() if line.strip()]
    matches = [re.fullmatch(pattern, line) for line in lines]
    for line, match in zip(lines, matches, strict=True):
        if match is None:
            fault = f"invalid line {line[:80]!r}, expected {form}"
            raise InputError(path, fault, _TAKE_LIST)
    _refuse_doubles(path, lines)
    return [match.groups() for match in matches if match]


def require_files(
    root: pathlib.Path, wanted: Mapping[str, Sequence[str]], listed_in: str, layout: str
) -> None:
    """Raises InputError, with the first few missing files and the published layout,
    unless every wanted file is there: folder -> names in it."""
    missing: list[tuple[str, str]] = []
    total = 0
    for folder, names in wanted.items():
        present = _names_in(root / folder)
        missing += [(folder, name) for name in names if name not in present]
        total += len(names)
    if missing:
        paths = [str(pathlib.PurePosixPath(*parts)) for parts in missing[:_SHOWN]]
        first = ", ".join(paths + ["..."] * (len(missing) > _SHOWN))
        fault = f"{len(missing)} of the {total} files in {listed_in} are missing"
        remedy = f"copy the whole data set here, as {layout}"
        raise InputError(root, f"{fault}: {first}", remedy)


def read_cloud(
    path: pathlib.Path, num_points: int | None = None
) -> Float32[np.ndarray, "N 3"]:
    """The points of an NPY file, as `sound_cloud` wants them."""
    return sound_cloud(read_npy(path), path, num_points)


def sound_cloud(
    points: np.ndarray, subject: StrPath, num_points: int | None = None
) -> Float32[np.ndarray, "N 3"]:
    """The points as float32; another shape or count, or a NaN, raises InputError."""
    is_cloud = points.ndim == 2 and points.shape[1] == 3 and len(points) > 0
    if not is_cloud or points.dtype.kind not in "fiu":
        fault = f"array of shape {points.shape} and type {points.dtype}"
        raise InputError(subject, f"{fault} is not a cloud", _COPY_AGAIN)
    if num_points is not None and len(points) != num_points:
        fault = f"{len(points)} points instead of {num_points}"
        raise InputError(subject, fault, _COPY_AGAIN)
    with np.errstate(over="ignore"):
        cloud = np.ascontiguousarray(points, np.float32)
    if not np.isfinite(cloud).all():
        raise InputError(subject, "some points are not finite", _COPY_AGAIN)
    return cloud


def _read_text(path: StrPath) -> str:
    try:
        return read_bytes(path).decode()
    except UnicodeDecodeError:
        raise InputError(path, "not a text file", _TAKE_LIST) from None


def _refuse_doubles(path: StrPath, entries: Sequence[object]) -> None:
    if not entries:
        raise InputError(path, "no objects listed", _TAKE_LIST)
    if len(set(entries)) < len(entries):
        raise InputError(path, "duplicate object", _TAKE_LIST)


def _names_in(folder: pathlib.Path) -> set[str]:
    try:
        return set(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return set()
    except OSError as error:
        raise unreadable(folder, error) from None
