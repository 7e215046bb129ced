"""Arrays of HDF5 files; each process opens its own handles."""

import contextlib
import functools
import math
import os
from collections.abc import Iterator

import h5py
import numpy as np

from prism_jax.io.errors import InputError

_REMEDY = "copy this file again from the set"
_MAX_NUMBERS = 2**22
"""Of an array that is read whole: a cloud has some ten thousand."""


@contextlib.contextmanager
def opened(path: str | os.PathLike, keep: bool = False) -> Iterator[h5py.File]:
    """A file for reading; with `keep` this process leaves it open for the next time.

    What h5py raises in the block for a missing, damaged or cut file becomes an
    InputError. A file that is kept is worth it where chunks are cached: each process
    has a handle of its own, and none is ever pickled.
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


def find_array(file: h5py.File, name: str) -> h5py.Dataset:
    """An array of an open file, unread; where there is none, raises InputError."""
    found = file.get(name)
    if not isinstance(found, h5py.Dataset) or found.shape is None:
        held = ", ".join(file) or "nothing"
        fault = f"has no array {name!r}: it holds {held}"
        raise InputError(file.filename, fault, _REMEDY)
    return found


def _open(path: str | os.PathLike) -> h5py.File:
    """Without the lock that some network drives refuse; nobody writes here."""
    return h5py.File(path, "r", locking=False)


@functools.lru_cache(maxsize=16)
def _kept(path: str, process: int) -> h5py.File:
    return _open(path)
