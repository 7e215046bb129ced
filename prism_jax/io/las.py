"""LAS and LAZ point clouds, read by laspy (the extra `las`)."""

import io
import struct

import numpy as np
from jaxtyping import Float

from prism_jax.io.arrays import Fields
from prism_jax.io.errors import StrPath, require
from prism_jax.io.files import MAX_POINTS, check_count, parsing, read_bytes

_REMEDY = "export it again, for example with las2las or CloudCompare"
_BLOCK = 100_000  # points unpacked at once: of a cut file no more memory is taken
_RECORDS = 100  # where the header has the number of its records
_RECORD_BYTES, _CHUNK_BYTES = 54, 20  # the least that one takes
_PARTS = 34  # where LAZ has the type, size and version of each part of a point
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of each type; extra bytes have one a byte


def read_las(
    path: StrPath, max_points: int = MAX_POINTS, fields: Fields | None = None
) -> Float[np.ndarray, "N 3"]:
    """Positions with the header's scale and offset, float64. `fields` gets what is not
    zero everywhere, by laspy's names. A malformed or cut file, more than `max_points`
    points, and a missing laspy raise an InputError."""
    laspy, lazrs = require("laspy", "las"), require("lazrs", "las")
    data = read_bytes(path)
    # laspy and its codecs raise errors of many kinds.
    with parsing(path, "a valid LAS or LAZ file", _REMEDY, Exception):
        claimed = struct.unpack_from("<I", data, _RECORDS)[0] * _RECORD_BYTES
        how = {"read_evlrs": False, "laz_backend": laspy.LazBackend.Lazrs}
        source = io.BytesIO(data if claimed <= len(data) else b"")
        with laspy.open(source, **how) as reader:
            header = reader.header
            check_count(header.point_count, max_points)
            claimed = header.point_count * header.point_format.size
            if header.are_points_compressed:
                # For as many chunks as a table claims lazrs takes memory, or ends the
                # process. A streamed file has the place of its table last.
                (place,) = struct.unpack_from("<q", data, header.offset_to_point_data)
                if place == -1:
                    (place,) = struct.unpack_from("<q", data, len(data) - 8)
                claimed = struct.unpack_from("<I", data, place + 4)[0] * _CHUNK_BYTES
                vlr = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
                _check_layers(data, header, place, vlr)
            if not 0 < claimed <= len(data):
                raise ValueError("no points, or the file is truncated")
            blocks = list(reader.chunk_iterator(_BLOCK))
        for name in header.point_format.dimension_names:
            column = np.concatenate([np.asarray(block[name]) for block in blocks])
            wanted = column.ndim == 1 and name not in ("X", "Y", "Z")
            if fields is not None and wanted and column.any():
                fields[name] = column
        return np.concatenate([np.stack([b.x, b.y, b.z], axis=1) for b in blocks])


def _check_layers(data: bytes, header, end: int, vlr) -> None:
    """ValueError unless the chunks' layers go on up to the table of chunks: lazrs takes
    as much memory as they claim."""
    parts = np.frombuffer(vlr.record_data(), "<u2", offset=_PARTS).reshape(-1, 3)
    if parts[0, 2] < 3:
        return  # older versions have none
    layers = sum(_LAYERS.get(int(kind), int(size)) for kind, size, _ in parts)
    start, count = header.offset_to_point_data + 8, 0
    while start < end:
        start += vlr.item_size() + 4  # the first point, and the number of all
        sizes = np.frombuffer(data, "<u4", layers, start)
        start, count = start + sizes.nbytes + int(sizes.sum()), count + 1
    is_whole = start == end and count * vlr.chunk_size() >= header.point_count
    if not is_whole or count != struct.unpack_from("<I", data, end + 4)[0]:
        raise ValueError("its layers are damaged")
