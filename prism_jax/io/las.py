"""LAS and LAZ point clouds, read by laspy (the extra `las`)."""

import io
import struct

import numpy as np
from jaxtyping import Float

from prism_jax.io.arrays import Fields
from prism_jax.io.errors import StrPath, require
from prism_jax.io.files import MAX_POINTS, check_count, parsing, read_bytes

_REMEDY = "export it again, for example with las2las or CloudCompare"
_BLOCK = 100_000  # points unpacked at once: of a damaged file no more is allocated
_RECORDS = 100  # where the header has the number of its records
_RECORD_BYTES, _CHUNK_BYTES = 54, 20  # the least that one takes


def read_las(
    path: StrPath, max_points: int = MAX_POINTS, fields: Fields | None = None
) -> Float[np.ndarray, "N 3"]:
    """Positions with the header's scale and offset, float64: map coordinates keep their
    millimetres. `fields` gets the dimensions that are not zero everywhere, by laspy's
    names. A malformed or cut file and one of more than `max_points` points raise an
    InputError, and so does a missing laspy."""
    laspy, _ = require("laspy", "las"), require("lazrs", "las")
    data = read_bytes(path)
    # laspy and its codecs raise errors of many kinds.
    with parsing(path, "a valid LAS or LAZ file", _REMEDY, Exception):
        (records,) = struct.unpack_from("<I", data, _RECORDS)
        _check_size(records * _RECORD_BYTES, data)
        how = {"read_evlrs": False, "laz_backend": laspy.LazBackend.Lazrs}
        with laspy.open(io.BytesIO(data), **how) as reader:
            header = reader.header
            check_count(header.point_count, max_points)
            if not header.point_count:
                raise ValueError("no points")
            if header.are_points_compressed:
                num_chunks = _num_chunks(data, header.offset_to_point_data)
                _check_size(num_chunks * _CHUNK_BYTES, data)
            else:
                _check_size(header.point_count * header.point_format.size, data)
            blocks = list(reader.chunk_iterator(_BLOCK))
        for name in header.point_format.dimension_names:
            column = np.concatenate([np.asarray(block[name]) for block in blocks])
            if fields is not None and name not in ("X", "Y", "Z") and column.any():
                fields[name] = column
        xyz = [np.stack([block.x, block.y, block.z], axis=1) for block in blocks]
        return np.concatenate(xyz)


def _num_chunks(data: bytes, start: int) -> int:
    """How many chunks a LAZ file's table claims to list: lazrs takes memory for them,
    and ends the process where there is none. A streamed file has its place last."""
    (place,) = struct.unpack_from("<q", data, start)
    if place == -1:
        (place,) = struct.unpack_from("<q", data, len(data) - 8)
    return struct.unpack_from("<I", data, place + 4)[0]


def _check_size(claimed: int, data: bytes) -> None:
    if claimed > len(data):
        raise ValueError("the file is truncated")
