"""Point clouds in NumPy's own files. Nothing is ever unpickled."""

import io
import math
import warnings
import zipfile
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.lib import format as npy_format

from prism_jax.io.errors import StrPath
from prism_jax.io.files import MAX_POINTS, check_count, read_bytes, unsound

MAX_MEMBERS = 1000  # an archive with more arrays is refused: the header of each is read

_HEADER_READERS = {
    (1, 0): npy_format.read_array_header_1_0,
    (2, 0): npy_format.read_array_header_2_0,
}
_HEAD_BYTES = 2**16
_ENTRY = b"PK\1\2"  # every entry of an archive's directory starts with it
_REMEDY = "save an (N, 3) array of numbers with numpy.save or numpy.savez(xyz=...)"


def read_npy(path: StrPath, max_points: int = MAX_POINTS) -> Float[np.ndarray, "N 3"]:
    """The array of an NPY file: float32 stays so, other real numbers become float64. An
    array that is not (N, 3), of complex numbers or of objects, more than `max_points`
    rows, and a file that is cut raise an InputError."""
    data = read_bytes(path)
    try:
        return _parse(data, max_points)
    except (ValueError, EOFError) as error:
        raise unsound(path, "a valid NPY cloud", error, _REMEDY) from None


def read_npz(path: StrPath, max_points: int = MAX_POINTS) -> Float[np.ndarray, "N 3"]:
    """The array `xyz` or `points` of an NPZ file, or its only (N, 3) array. Of other
    arrays the headers alone are read; more than `MAX_MEMBERS` arrays raise an
    InputError. Otherwise as `read_npy`."""
    data = read_bytes(path)
    try:
        if data.count(_ENTRY) > MAX_MEMBERS:
            raise ValueError(f"more than {MAX_MEMBERS:,} arrays")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _read_archive(archive, max_points)
    except Exception as error:  # zipfile and its codecs raise errors of many kinds
        raise unsound(path, "a valid NPZ cloud", error, _REMEDY) from None


def stack_columns(
    columns: Iterable[np.ndarray], stored: Iterable[np.dtype]
) -> Float[np.ndarray, "N 3"]:
    """Three columns as a cloud: float32 if all were stored so, else float64. What does
    not fit the type becomes infinite, without a warning."""
    is_single = all(dtype.kind == "f" and dtype.itemsize == 4 for dtype in stored)
    target = np.float32 if is_single else np.float64
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([column.astype(target) for column in columns], axis=1)


class _Header(NamedTuple):
    """What an NPY file says of its array, and where the numbers start."""

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype
    start: int

    @property
    def is_cloud(self) -> bool:
        shape, kind = self.shape, self.dtype.kind
        return len(shape) == 2 and shape[0] > 0 and shape[1] == 3 and kind in "fiu"

    @property
    def end(self) -> int:
        return self.start + math.prod(self.shape) * self.dtype.itemsize

    def __str__(self) -> str:
        return f"an array of shape {self.shape} and type {self.dtype}"


def _read_archive(archive: zipfile.ZipFile, max_points: int) -> np.ndarray:
    found: dict[str, tuple[str, _Header]] = {}
    for member in archive.namelist():
        with archive.open(member) as file:
            header = _parse_header(file.read(_HEAD_BYTES))
        found[member.removesuffix(".npy")] = member, header
    clouds = [name for name, (_, header) in found.items() if header.is_cloud]
    named = [name for name in ("xyz", "points") if name in clouds]
    if not clouds:
        held = ", ".join(f"{name}: {header}" for name, (_, header) in found.items())
        raise ValueError(f"no (N, 3) array of numbers ({held or 'nothing'})")
    if not named and len(clouds) > 1:
        raise ValueError(f"several arrays could be the cloud: {', '.join(clouds)}")
    member, header = found[(named or clouds)[0]]
    check_count(header.shape[0], max_points)
    with archive.open(member) as file:
        return _parse(file.read(header.end), max_points)


def _parse(data: bytes, max_points: int) -> np.ndarray:
    """The cloud in an NPY file's bytes; nothing is allocated before it is known to fit.
    Whatever is wrong with them raises a ValueError."""
    header = _parse_header(data)
    if not header.is_cloud:
        raise ValueError(f"found {header}")
    check_count(header.shape[0], max_points)
    if header.end > len(data):
        raise ValueError("the file is truncated")
    array = np.frombuffer(data, header.dtype, math.prod(header.shape), header.start)
    array = array.reshape(header.shape, order="F" if header.is_fortran else "C")
    return stack_columns(array.T, [header.dtype])


def _parse_header(data: bytes) -> _Header:
    file = io.BytesIO(data)
    version = npy_format.read_magic(file)
    if version not in _HEADER_READERS:
        raise ValueError(f"NPY version {version} is not supported")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            shape, is_fortran, dtype = _HEADER_READERS[version](file)
    except Exception:  # NumPy evaluates the header, and lets pass what that raises
        raise ValueError("damaged header") from None
    if any(type(side) is not int for side in shape):
        raise ValueError("damaged header")  # True is an int to NumPy
    return _Header(shape, is_fortran, dtype, file.tell())
