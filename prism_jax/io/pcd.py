"""PCD point clouds of the Point Cloud Library, in all three storage modes.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. pypcd4
reads it too, but not files of versions before 0.7 or without COUNT, and it trusts the
header's sizes.
"""

import struct
from collections.abc import Sequence
from typing import NamedTuple

import lzf
import numpy as np
from jaxtyping import Float

from prism_jax.io import files
from prism_jax.io.arrays import Fields, stack_columns
from prism_jax.io.errors import StrPath
from prism_jax.io.text import body_lines, header_lines, parse_rows

_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_LZF_MAX_RATIO = 100  # LZF's longest match is 264 bytes in a token of three
_MAX_COUNT = 2**16
"""Values of one field for one point; the longest known descriptors have 2,000."""
_REMEDY = "export it again, for example with pcl_convert_pcd_ascii_binary"
_SHORT = "the file is truncated"


class _Field(NamedTuple):
    name: str
    dtype: np.dtype
    count: int


class _Header(NamedTuple):
    fields: list[_Field]
    num_points: int
    mode: str

    def places(self, everything: bool) -> list[int]:
        """Where x, y and z are and, of everything, the other fields of one number."""
        known = [field.name.lower() for field in self.fields]
        single = [i for i, field in enumerate(self.fields) if field.count == 1]
        xyz = [i for axis in "xyz" for i in single if known[i] == axis]
        if [known[i] for i in xyz] != [*"xyz"]:
            raise ValueError(f"fields are {' '.join(known)}, not x y z")
        others = [i for i in single if everything and i not in xyz and known[i] != "_"]
        return xyz + [i for i in others if self.fields[i].dtype.kind != "V"]


def read_pcd(
    path: StrPath, max_points: int = files.MAX_POINTS, fields: Fields | None = None
) -> Float[np.ndarray, "N 3"]:
    """Positions as stored: float32 where x, y and z are, else float64. `fields` gets
    what else there is one of a point.

    Rows that are not finite, as where an organised cloud saw nothing, are kept; for
    VIEWPOINT see `read_viewpoint`. A malformed or cut file and one of more than
    `max_points` points raise an InputError.
    """
    data = files.read_bytes(path)
    with files.parsing(path, "a valid PCD file", _REMEDY):
        header, start = _parse_header(data)
        files.check_count(header.num_points, max_points)
        indices = header.places(fields is not None)
        read = _read_ascii if header.mode == "ascii" else _read_binary
        columns = read(data[start:], header, indices)
        names, stored, _ = zip(*(header.fields[i] for i in indices), strict=True)
        return stack_columns(columns, stored, names[3:], fields)


def read_viewpoint(path: StrPath) -> Float[np.ndarray, "3"] | None:
    """Where VIEWPOINT says that the sensor stood; None where it says nothing, or the
    origin, as writers do that do not know."""
    lines, _ = header_lines(files.read_bytes(path), "DATA", 2**16)
    given = [line[1:4] for line in lines if line[:1] == ["VIEWPOINT"]]
    try:
        eye = np.array(given, float)
    except ValueError:
        return None
    is_said = eye.shape == (1, 3) and np.isfinite(eye).all() and eye.any()
    return eye[0] if is_said else None


def _parse_header(data: bytes) -> tuple[_Header, int]:
    """The header, and where the points start."""
    lines, start = header_lines(data, "DATA", 2**16)
    entries = {words[0].upper(): words[1:] for words in lines if words}
    mode = " ".join(entries["DATA"]).lower()
    if mode not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA mode {mode!r} is unknown")
    return _Header(_fields(entries), _num_points(entries), mode), start


def _fields(entries: dict[str, list[str]]) -> list[_Field]:
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    counts = entries.get("COUNT", ["1"] * len(names))
    sizes, types = entries.get("SIZE", []), entries.get("TYPE", [])
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
    fields = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if not 0 <= int(count) <= _MAX_COUNT:
            raise ValueError(f"field {name!r} has an invalid count")
        known = int(size) in _SIZES.get(kind.upper(), ())
        if not known and (name.lower() in "xyz" or int(size) < 0):
            raise ValueError(f"field {name!r} has an unknown type")
        dtype = np.dtype(f"<{kind.lower() if known else 'V'}{int(size)}")
        fields.append(_Field(name, dtype, int(count)))
    return fields


def _num_points(entries: dict[str, list[str]]) -> int:
    width, height, points = (
        int(" ".join(entries[key])) if key in entries else None
        for key in ("WIDTH", "HEIGHT", "POINTS")
    )
    count = points if width is None else width * (1 if height is None else height)
    if count is None or count < 0 or points not in (None, count):
        raise ValueError("WIDTH x HEIGHT differs from POINTS")
    if count == 0:
        raise ValueError("no points")
    return count


def _read_ascii(
    body: bytes, header: _Header, indices: Sequence[int]
) -> list[np.ndarray]:
    if header.num_points > len(body):
        raise ValueError(_SHORT)
    firsts = np.cumsum([0, *(field.count for field in header.fields)]).tolist()
    columns = [firsts[index] for index in indices]
    return list(parse_rows(body_lines(body), columns, header.num_points).T)


def _read_binary(
    body: bytes, header: _Header, indices: Sequence[int]
) -> list[np.ndarray]:
    """Of points one after the other or, compressed, of fields one after the other."""
    count = header.num_points
    sizes = (field.dtype.itemsize * field.count for field in header.fields)
    *starts, size = np.cumsum([0, *sizes]).tolist()
    strides = (size,)
    if header.mode == "binary_compressed":
        body, strides = _unpacked(body, count * size), None
        starts = [count * start for start in starts]
    elif count * size > len(body):
        raise ValueError(_SHORT)
    kinds = [field.dtype for field in header.fields]
    return [np.ndarray(count, kinds[i], body, starts[i], strides) for i in indices]


def _unpacked(body: bytes, size: int) -> bytes:
    if len(body) < 8:
        raise ValueError(_SHORT)
    packed_size, plain_size = struct.unpack_from("<II", body)
    if packed_size > len(body) - 8:
        raise ValueError(_SHORT)
    if plain_size != size or size > _LZF_MAX_RATIO * packed_size:
        raise ValueError("compressed size differs from the header")
    if size > files.MAX_FILE_BYTES:
        raise ValueError(f"fields unpack to {size / 2**30:.1f} GiB")
    plain = lzf.decompress(body[8 : 8 + packed_size], size)
    if plain is None or len(plain) != size:
        raise ValueError("damaged compressed data")
    return plain
