"""Point clouds in NumPy's own files. Nothing is ever unpickled."""

import io
import math
import re
import zipfile
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.lib import format as npy_format

from prism_jax.io.errors import StrPath
from prism_jax.io.files import MAX_POINTS, check_count, parsing, read_bytes

Fields = dict[str, np.ndarray]  # further numbers of each point, by their names

MAX_MEMBERS = 1000  # an archive with more arrays is refused: the header of each is read

_ENTRY = b"PK\1\2"  # every entry of an archive's directory starts with it
_MAX_COLUMNS = 16  # an array of more is an image
_REMEDY = "save an (N, 3) array of numbers with numpy.save or numpy.savez(xyz=...)"


def read_npy(
    path: StrPath, max_points: int = MAX_POINTS, fields: Fields | None = None
) -> Float[np.ndarray, "N C"]:
    """The array of an NPY file, (N, C) or (H, W, C) with three to 16 columns, or its
    fields x, y and z: float32 stays so, other real numbers become float64. `fields`
    gets what other names hold. Any other array, more than `max_points` rows, and a file
    that is cut raise an InputError."""
    data = read_bytes(path)
    with parsing(path, "a valid NPY cloud", _REMEDY):
        return _parse(data, max_points, fields)


def read_kitti(
    path: StrPath, max_points: int = MAX_POINTS, fields: Fields | None = None
) -> Float[np.ndarray, "N 3"]:
    """The positions of a sweep as KITTI has it: x, y, z and a reflectance of 0 to 255,
    which `fields` gets, all float32. A file of other numbers raises an InputError."""
    data = read_bytes(path)
    with parsing(path, "a KITTI sweep", _REMEDY):
        check_count(len(data) // 16, max_points)
        if len(data) % 16:
            raise ValueError("its points do not take 16 bytes each")
        rows = np.frombuffer(data, "<f4").reshape(-1, 4)
        if ((rows[:, 3] < 0) | (rows[:, 3] > 255)).any():
            raise ValueError("the fourth number of a point is no reflectance")
        return stack_columns(rows.T, [rows.dtype] * 4, ["reflectance"], fields)


def read_npz(
    path: StrPath, max_points: int = MAX_POINTS, fields: Fields | None = None
) -> Float[np.ndarray, "N C"]:
    """The array `xyz` or `points` of an NPZ file, or its only (N, 3) array, or its only
    other one that `read_npy` takes and that has more rows than columns. `fields` gets
    arrays of as many rows and up to four columns; of others the headers alone are read.
    More than `MAX_MEMBERS` arrays raise an InputError. Otherwise as `read_npy`."""
    data = read_bytes(path)
    # zipfile and its codecs raise errors of many kinds.
    with parsing(path, "a valid NPZ cloud", _REMEDY, Exception):
        if data.count(_ENTRY) > MAX_MEMBERS:
            raise ValueError(f"more than {MAX_MEMBERS:,} arrays")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _read_archive(archive, max_points, fields)


def stack_columns(
    columns: Iterable[np.ndarray],
    stored: Iterable[np.dtype],
    names: Sequence[str] = (),
    fields: Fields | None = None,
) -> Float[np.ndarray, "N C"]:
    """Columns as a cloud: float32 if all were stored so, else float64. What does not
    fit the type becomes infinite, without a warning. The last columns, those that have
    `names`, go to the `fields` instead, in the type that they are stored in."""
    columns, stored = list(columns), [dtype.newbyteorder("=") for dtype in stored]
    count = len(columns) - len(names)
    is_single = all(dtype == np.float32 for dtype in stored[:count])
    target = np.float32 if is_single else np.float64
    with np.errstate(over="ignore", invalid="ignore"):
        if fields is not None:
            further = zip(names, columns[count:], stored[count:], strict=True)
            fields |= {name: column.astype(kind) for name, column, kind in further}
        return np.stack([column.astype(target) for column in columns[:count]], axis=1)


def check_not_index(column: Float[np.ndarray, " N"]) -> None:
    """Raise a ValueError if what would be x is but the number of each row."""
    if len(column) > 9 and np.array_equal(column, column[0] + np.arange(len(column))):
        raise ValueError("the first column counts the rows: which are x, y and z?")


class _Header(NamedTuple):
    """What an NPY file says of its array, and where the numbers start."""

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype
    start: int

    @property
    def count(self) -> int:
        """Points: rows of three to 16 numbers, or of fields that include x, y and z."""
        if {*"xyz"} <= {*(self.dtype.names or ())}:
            return math.prod(self.shape)
        if len(self.shape) < 2 or min(self.shape) < 1 or self.dtype.kind not in "fiu":
            return 0
        is_table = 3 <= self.shape[-1] <= _MAX_COLUMNS
        return math.prod(self.shape[:-1]) if is_table else 0

    @property
    def end(self) -> int:
        return self.start + math.prod(self.shape) * self.dtype.itemsize

    def __str__(self) -> str:
        return f"an array of shape {self.shape} and type {self.dtype}"


def _read_archive(
    archive: zipfile.ZipFile, max_points: int, fields: Fields | None
) -> np.ndarray:
    found: dict[str, tuple[str, _Header]] = {}
    for member in archive.namelist():
        with archive.open(member) as file:
            header = _parse_header(file.read(2**16))
        found[member.removesuffix(".npy")] = member, header
    counts = {name: header.count for name, (_, header) in found.items()}
    exact = [n for n in counts if counts[n] and found[n][1].shape[1:] == (3,)]
    clouds = exact or [n for n in counts if counts[n] > _MAX_COLUMNS]
    named = [name for name in ("xyz", "points") if name in clouds]
    if not clouds:
        held = ", ".join(f"{name}: {header}" for name, (_, header) in found.items())
        raise ValueError(f"no (N, 3) array of numbers ({held or 'nothing'})")
    if not named and len(clouds) > 1:
        raise ValueError(f"several arrays could be the cloud: {', '.join(clouds)}")
    member, header = found[(named or clouds)[0]]
    check_count(header.count, max_points)
    for name, (other, its) in found.items():
        columns = math.prod(its.shape[1:])
        beside = its.shape[:1] == header.shape[:1] and columns <= 4
        is_number = its.dtype.kind in "biuf"
        if fields is None or other == member or not (beside and is_number):
            continue
        with archive.open(other) as file:
            data = file.read(its.end)
        if len(data) == its.end:  # what is cut does not spoil the cloud
            rows = np.frombuffer(data, its.dtype, offset=its.start)
            order = "F" if its.is_fortran else "C"
            table = rows.reshape((-1, columns), order=order)
            fields |= zip(_names_of(name, columns), table.T, strict=True)
    with archive.open(member) as file:
        return _parse(file.read(header.end), max_points, fields)


def _names_of(name: str, columns: int) -> Sequence[str]:
    """Of an array's columns, as PLY has them."""
    if columns == 1:
        return [name]
    if re.search("colou?r|rgb", name.lower()):
        return ("red", "green", "blue", "alpha")[:columns]
    if columns == 3 and "normal" in name.lower():
        return "nx", "ny", "nz"
    return [f"{name}_{axis}" for axis in range(columns)]


def _parse(data: bytes, max_points: int, fields: Fields | None) -> np.ndarray:
    """The cloud in an NPY file's bytes; nothing is allocated before it is known to fit.
    Whatever is wrong with them raises a ValueError."""
    header = _parse_header(data)
    if not header.count:
        raise ValueError(f"found {header}")
    check_count(header.count, max_points)
    if header.end > len(data):
        raise ValueError("the file is truncated")
    array = np.frombuffer(data, header.dtype, math.prod(header.shape), header.start)
    array = array.reshape(header.shape, order="F" if header.is_fortran else "C")
    names = []
    if header.dtype.names:
        kinds = {n: header.dtype[n].kind for n in header.dtype.names}
        names = [n for n in kinds if n not in {*"xyz"} and kinds[n] in "biuf"]
        columns = [array[name].ravel() for name in (*"xyz", *names)]
    else:
        columns = list(array.reshape(-1, header.shape[-1]).T)
    if len(columns) > 3 + len(names):
        check_not_index(columns[0])
    stored = [column.dtype for column in columns]
    return stack_columns(columns, stored, names, fields)


def _parse_header(data: bytes) -> _Header:
    file = io.BytesIO(data)
    version = npy_format.read_magic(file)
    reader = getattr(npy_format, "read_array_header_{}_{}".format(*version), None)
    if reader is None:
        raise ValueError(f"NPY version {version} is not supported")
    try:
        shape, is_fortran, dtype = reader(file)
    except Exception:  # NumPy evaluates the header, and lets pass what that raises
        raise ValueError("damaged header") from None
    if any(type(side) is not int for side in shape):
        raise ValueError("damaged header")  # True is an int to NumPy
    return _Header(shape, is_fortran, dtype, file.tell())
