"""Arrays of HDF5 files; each process opens its own handles."""

import contextlib
import functools
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from prism_jax.io.errors import InputError, require

_REMEDY = "copy this file again from the set"
_MAX_NUMBERS = 2**22
"""Of an array that is read whole: a cloud has some ten thousand."""


@contextlib.contextmanager
def opened(path: str | os.PathLike, keep: bool = False) -> Iterator[Any]:
    """An `h5py.File` for reading; with `keep` it stays open for the next call.

    What h5py raises in the block for a missing, damaged or cut file becomes an
    InputError. Keep a file open where its chunks are worth caching: each process has a
    handle of its own, and none is ever pickled.
    """
    try:
        if keep:
            yield _kept(os.fspath(path), os.getpid())
        else:
            with _open(path) as file:
                yield file
    except (OSError, KeyError, RuntimeError) as error:
        fault = f"cannot be read as HDF5 ({error})"
        raise InputError(path, fault, _REMEDY) from None


def read_array(path: str | os.PathLike, name: str) -> np.ndarray:
    """One small array, whole."""
    with opened(path) as file:
        dataset = find_array(file, name)
        if math.prod(dataset.shape) > _MAX_NUMBERS:
            fault = f"has an array {name!r} of shape {dataset.shape}, which is no cloud"
            raise InputError(path, fault, _REMEDY)
        return dataset[()]


def find_array(file: Any, name: str) -> Any:
    """The `h5py.Dataset` of an open `h5py.File`, unread.

    HDF5 can point to data elsewhere: links, external storage and virtual arrays all
    name other files by path. None of these is followed. They, and a file without the
    array, raise InputError.
    """
    h5py = require("h5py", "data")
    link = file.get(name, getlink=True)
    if link is not None and not isinstance(link, h5py.HardLink):
        fault = f"has a link in place of the array {name!r}"
        raise InputError(file.filename, fault, "store the array in the file itself")
    found = file.get(name)
    if not isinstance(found, h5py.Dataset) or found.shape is None:
        held = ", ".join(file) or "nothing"
        fault = f"has no array {name!r}: it holds {held}"
        raise InputError(file.filename, fault, _REMEDY)
    if found.external or found.is_virtual:
        fault = f"keeps the array {name!r} in other files"
        raise InputError(file.filename, fault, "store the array in the file itself")
    return found


def _open(path: str | os.PathLike) -> Any:
    """Without the lock that some network drives refuse; nobody writes here."""
    return require("h5py", "data").File(path, "r", locking=False)


@functools.lru_cache(maxsize=16)
def _kept(path: str, process: int) -> Any:
    return _open(path)
