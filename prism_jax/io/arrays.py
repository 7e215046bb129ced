"""Point clouds in NumPy's own files. Nothing is ever unpickled."""

import io
import lzma
import math
import os
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float
from numpy.lib import format as npy_format

from prism_jax.io.files import MAX_POINTS, check_count, read_bytes, unsound

_HEADER_READERS = {
    (1, 0): npy_format.read_array_header_1_0,
    (2, 0): npy_format.read_array_header_2_0,
}
MAX_MEMBERS = 1000  # an archive with more arrays is refused: the header of each is read

_HEAD_BYTES = 2**16
_ENTRY = b"PK\1\2"  # every entry of an archive's directory starts with it
_REMEDY = "save an (N, 3) array of numbers with numpy.save or numpy.savez(xyz=...)"


def read_npy(
    path: str | os.PathLike, max_points: int = MAX_POINTS
) -> Float[np.ndarray, "N 3"]:
    """The array of an NPY file: float32 stays so, other real numbers become float64.

    Rows that are not finite are kept. An array of another shape, of complex numbers or
    of objects, one with more than `max_points` rows, and a file that is cut raise an
    InputError.
    """
    data = read_bytes(path)
    try:
        return _parse(data, max_points)
    except (ValueError, EOFError) as error:
        raise unsound(path, "a valid NPY cloud", error, _REMEDY) from None


def read_npz(
    path: str | os.PathLike, max_points: int = MAX_POINTS
) -> Float[np.ndarray, "N 3"]:
    """The array `xyz` or `points` of an NPZ file, or its only (N, 3) array.

    Of other arrays the headers alone are read; more than `MAX_MEMBERS` arrays raise an
    InputError. Otherwise as `read_npy`.
    """
    data = read_bytes(path)
    try:
        if data.count(_ENTRY) > MAX_MEMBERS:
            raise ValueError(f"more than {MAX_MEMBERS:,} arrays")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _read_member(archive, _choose_member(archive), max_points)
    except (
        ValueError,
        EOFError,
        OSError,
        lzma.LZMAError,
        NotImplementedError,
        RuntimeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise unsound(path, "a valid NPZ cloud", error, _REMEDY) from None


def stack_columns(
    columns: Iterable[np.ndarray], stored: Iterable[np.dtype]
) -> Float[np.ndarray, "N 3"]:
    """Three columns as a cloud: float32 if all were stored so, else float64.

    What does not fit the type becomes infinite, without a warning.
    """
    is_single = all(dtype.kind == "f" and dtype.itemsize == 4 for dtype in stored)
    target = np.float32 if is_single else np.float64
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([column.astype(target) for column in columns], axis=1)


def _choose_member(archive: zipfile.ZipFile) -> str:
    found, clouds = {}, {}
    for member in archive.namelist():
        with archive.open(member) as file:
            head = file.read(_HEAD_BYTES)
        shape, _, dtype, _ = _parse_header(head)
        found[member.removesuffix(".npy")] = (shape, dtype)
        if _is_cloud(shape, dtype):
            clouds[member.removesuffix(".npy")] = member
    for name in ("xyz", "points", *clouds):
        if name in clouds and (name in ("xyz", "points") or len(clouds) == 1):
            return clouds[name]
    if clouds:
        raise ValueError(f"several arrays could be the cloud: {', '.join(clouds)}")
    held = ", ".join(f"{name}: {_describe(*entry)}" for name, entry in found.items())
    raise ValueError(f"no (N, 3) array of numbers ({held or 'nothing'})")


def _read_member(archive: zipfile.ZipFile, member: str, max_points: int) -> np.ndarray:
    with archive.open(member) as file:
        head = file.read(_HEAD_BYTES)
        shape, _, dtype, start = _parse_header(head)
        check_count(shape[0], max_points)
        size = start + math.prod(shape) * dtype.itemsize
        return _parse(head + file.read(max(size - len(head), 0)), max_points)


def _parse(data: bytes, max_points: int) -> np.ndarray:
    """The cloud in an NPY file's bytes; nothing is allocated before it is known to fit.

    Whatever is wrong with them raises a ValueError.
    """
    shape, is_fortran, dtype, start = _parse_header(data)
    if not _is_cloud(shape, dtype):
        raise ValueError(f"found {_describe(shape, dtype)}")
    check_count(shape[0], max_points)
    if math.prod(shape) * dtype.itemsize > len(data) - start:
        raise ValueError("the file is truncated")
    array = np.frombuffer(data, dtype, math.prod(shape), start)
    array = array.reshape(shape, order="F" if is_fortran else "C")
    return stack_columns(array.T, [dtype])


def _parse_header(data: bytes) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, Fortran order or not, type, and where the numbers start."""
    file = io.BytesIO(data)
    version = npy_format.read_magic(file)
    if version not in _HEADER_READERS:
        raise ValueError(f"NPY version {version} is not supported")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            shape, is_fortran, dtype = _HEADER_READERS[version](file)
    except (
        SyntaxError,
        TypeError,
        LookupError,
        AttributeError,
        MemoryError,
        RecursionError,
        tokenize.TokenError,
    ):
        raise ValueError("damaged header") from None
    if any(type(side) is not int for side in shape):
        raise ValueError("damaged header")  # True is an int to NumPy
    return shape, is_fortran, dtype, file.tell()


def _is_cloud(shape: tuple[int, ...], dtype: np.dtype) -> bool:
    return len(shape) == 2 and shape[0] > 0 and shape[1] == 3 and dtype.kind in "fiu"


def _describe(shape: tuple[int, ...], dtype: np.dtype) -> str:
    return f"an array of shape {shape} and type {dtype}"
