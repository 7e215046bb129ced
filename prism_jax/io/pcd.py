"""PCD point clouds of the Point Cloud Library, in all three storage modes.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. pypcd4
reads it too, but not files of versions before 0.7 or without COUNT, and it trusts the
header's sizes.
"""

import dataclasses
import io
import os
import struct
from collections.abc import Sequence

import lzf
import numpy as np
from jaxtyping import Float, Num

from prism_jax.io.arrays import stack_columns
from prism_jax.io.files import (
    MAX_FILE_BYTES,
    MAX_POINTS,
    check_count,
    read_bytes,
    unsound,
)
from prism_jax.io.text import parse_rows

_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_LZF_MAX_RATIO = 100  # LZF's longest match is 264 bytes in a token of three
_MAX_COUNT = 2**16
"""Values of one field for one point; the longest known descriptors have 2,000."""
_REMEDY = "export it again, for example with pcl_convert_pcd_ascii_binary"
_SHORT = "the file is truncated"


@dataclasses.dataclass(frozen=True)
class _Field:
    name: str
    dtype: np.dtype
    count: int

    @property
    def num_bytes(self) -> int:
        return self.dtype.itemsize * self.count


@dataclasses.dataclass(frozen=True)
class _Header:
    fields: list[_Field]
    num_points: int
    mode: str
    size: int

    def indices(self, names: Sequence[str]) -> list[int]:
        """Where the fields of these names are; each must have one value a point."""
        known = [field.name for field in self.fields]
        for name in names:
            if [f.count for f in self.fields if f.name == name] != [1]:
                raise ValueError(f"fields are {' '.join(known)}, not {name}")
        return [known.index(name) for name in names]


def read_pcd(
    path: str | os.PathLike, max_points: int = MAX_POINTS
) -> Float[np.ndarray, "N 3"]:
    """Positions as stored: float32 where x, y and z are, else float64.

    Fields may come in any order, type and count. Rows that are not finite, as where an
    organised cloud saw nothing, are kept; VIEWPOINT is not applied. A malformed or cut
    file and one of more than `max_points` points raise an InputError; what the header
    claims is checked before memory is taken for it.
    """
    header, columns = _read(path, "xyz", max_points)
    chosen = [header.fields[index].dtype for index in header.indices("xyz")]
    return stack_columns(columns, chosen)


def read_pcd_field(
    path: str | os.PathLike, name: str, max_points: int = MAX_POINTS
) -> Num[np.ndarray, " N"]:
    """One more field of every point, such as a label, in the order of `read_pcd`.

    As stored; ASCII numbers are float64. A file without it, or with several values of
    it for a point, raises InputError, as does what `read_pcd` refuses.
    """
    _, (column,) = _read(path, [name], max_points)
    return column


def _read(
    path: str | os.PathLike, names: Sequence[str], max_points: int
) -> tuple[_Header, list[np.ndarray]]:
    """The header, and the columns of these fields."""
    data = read_bytes(path)
    try:
        header = _parse_header(data)
        check_count(header.num_points, max_points)
        indices = header.indices(names)
        return header, _READERS[header.mode](data[header.size :], header, indices)
    except ValueError as error:
        raise unsound(path, "a valid PCD file", error, _REMEDY) from None


def _parse_header(data: bytes) -> _Header:
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = data.find(b"\n", start, 2**16)
        if end < 0:
            raise ValueError("no DATA line in the header")
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    mode = " ".join(entries["DATA"]).lower()
    if mode not in _READERS:
        raise ValueError(f"DATA mode {mode!r} is unknown")
    return _Header(_fields(entries), _num_points(entries), mode, start)


def _fields(entries: dict[str, list[str]]) -> list[_Field]:
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    counts = entries.get("COUNT", ["1"] * len(names))
    sizes, types = entries.get("SIZE", []), entries.get("TYPE", [])
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
    fields = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if kind not in _KINDS or int(size) not in _SIZES[kind]:
            raise ValueError(f"field {name!r} has an unknown type")
        if not 0 <= int(count) <= _MAX_COUNT:
            raise ValueError(f"field {name!r} has an invalid count")
        dtype = np.dtype(f"<{_KINDS[kind]}{int(size)}")
        fields.append(_Field(name.lower(), dtype, int(count)))
    for axis in "xyz":
        if [f.count for f in fields if f.name == axis] != [1]:
            raise ValueError(f"fields are {' '.join(names)}, not x y z")
    return fields


def _num_points(entries: dict[str, list[str]]) -> int:
    sizes = {
        key: int(" ".join(entries[key]))
        for key in ("WIDTH", "HEIGHT", "POINTS")
        if key in entries
    }
    if "WIDTH" in sizes:
        num_points = sizes["WIDTH"] * sizes.get("HEIGHT", 1)
    else:
        num_points = sizes.get("POINTS", -1)
    if num_points < 0 or sizes.get("POINTS", num_points) != num_points:
        raise ValueError("WIDTH x HEIGHT differs from POINTS")
    if num_points == 0:
        raise ValueError("no points")
    return num_points


def _read_ascii(
    body: bytes, header: _Header, indices: Sequence[int]
) -> list[np.ndarray]:
    if header.num_points > len(body):
        raise ValueError(_SHORT)
    first_columns = np.cumsum([0] + [field.count for field in header.fields])
    lines = (line for line in io.BytesIO(body) if not line.isspace())
    columns = [int(first_columns[index]) for index in indices]
    return list(parse_rows(lines, columns, header.num_points).T)


def _read_binary(
    body: bytes, header: _Header, indices: Sequence[int]
) -> list[np.ndarray]:
    offsets = np.cumsum([0] + [field.num_bytes for field in header.fields]).tolist()
    if header.num_points * offsets[-1] > len(body):
        raise ValueError(_SHORT)
    names = [header.fields[index].name for index in indices]
    row = np.dtype(
        {
            "names": names,
            "formats": [header.fields[index].dtype for index in indices],
            "offsets": [offsets[index] for index in indices],
            "itemsize": offsets[-1],
        }
    )
    rows = np.frombuffer(body, dtype=row, count=header.num_points)
    return [rows[name] for name in names]


def _read_compressed(
    body: bytes, header: _Header, indices: Sequence[int]
) -> list[np.ndarray]:
    """The fields one after the other, each for all points, compressed together."""
    if len(body) < 8:
        raise ValueError(_SHORT)
    packed_size, size = struct.unpack_from("<II", body)
    num_bytes = [field.num_bytes * header.num_points for field in header.fields]
    if packed_size > len(body) - 8:
        raise ValueError(_SHORT)
    if size != sum(num_bytes) or size > _LZF_MAX_RATIO * packed_size:
        raise ValueError("compressed size differs from the header")
    if size > MAX_FILE_BYTES:
        raise ValueError(f"fields unpack to {size / 2**30:.1f} GiB")
    plain = lzf.decompress(body[8 : 8 + packed_size], size)
    if plain is None or len(plain) != size:
        raise ValueError("damaged compressed data")
    starts = np.cumsum([0, *num_bytes]).tolist()
    return [
        np.frombuffer(plain, header.fields[i].dtype, header.num_points, starts[i])
        for i in indices
    ]


_READERS = {
    "ascii": _read_ascii,
    "binary": _read_binary,
    "binary_compressed": _read_compressed,
}
