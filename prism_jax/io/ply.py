"""PLY point clouds: the vertices of any PLY file, and clouds written back.

plyfile reads headers and writes files. NumPy reads the vertices: plyfile reads every
number of an ASCII file and every list of a binary one by itself, and takes ten to a
hundred times as long.
"""

import io
import itertools
import os
import struct

import numpy as np
import plyfile
from jaxtyping import Bool, Float

from prism_jax.io import atomic
from prism_jax.io.arrays import stack_columns
from prism_jax.io.files import MAX_POINTS, check_count, read_bytes, unsound
from prism_jax.io.text import parse_rows

OBSERVED, COMPLETED = 0, 1
"""Values of the `label` property."""

COLORS = {OBSERVED: (37, 99, 175), COMPLETED: (230, 126, 34)}

_AXES = ("x", "y", "z")
_MAX_HEADER_BYTES = 2**18
_SHORT = "it is shorter than its header says"
_REMEDY = "export it again as a PLY point cloud"


def read_ply(
    path: str | os.PathLike, max_points: int = MAX_POINTS
) -> Float[np.ndarray, "N 3"]:
    """Vertex positions as stored: float32 where the file says float, else float64.

    ASCII and binary of either byte order. Elements before the vertices are skipped,
    with lists of any length; what comes after is not looked at. Rows that are not
    finite are kept. A malformed or cut file, and one of more than `max_points` vertices
    or rows before them, raise an InputError before memory is taken for what the header
    claims.
    """
    data = read_bytes(path)
    try:
        header, counts, start = _parse_header(data)
        before = list(itertools.takewhile(lambda e: e.name != "vertex", header))
        row = _vertex_row(header)
        check_count(counts["vertex"], max_points)
        check_count(sum(counts[e.name] for e in before), max_points, "rows before them")
        if header.text:
            lines = (line for line in io.BytesIO(data[start:]) if not line.isspace())
            skipped = sum(counts[e.name] for e in before if e.properties)
            lines = itertools.islice(lines, skipped, None)
            places = [list(row.names or ()).index(axis) for axis in _AXES]
            columns = parse_rows(lines, places, counts["vertex"]).T
        else:
            for element in before:
                start = _skip(
                    data, start, element, counts[element.name], header.byte_order
                )
            if start + counts["vertex"] * row.itemsize > len(data):
                raise ValueError(_SHORT)
            rows = np.frombuffer(data, row, counts["vertex"], start)
            columns = [rows[axis] for axis in _AXES]
        return stack_columns(columns, [row[axis] for axis in _AXES])
    except (ValueError, plyfile.PlyParseError) as error:
        raise unsound(path, "a sound PLY file", error, _REMEDY) from None


def write_ply(
    path: str | os.PathLike,
    points: Float[np.ndarray, "M 3"],
    labels: Bool[np.ndarray, " M"] | None = None,
) -> None:
    """Write `ply_bytes`, whole or not at all."""
    atomic.write_bytes(path, ply_bytes(points, labels))


def ply_bytes(
    points: Float[np.ndarray, "M 3"], labels: Bool[np.ndarray, " M"] | None = None
) -> bytes:
    """A file of points, which `read_ply` reads back bit for bit.

    With `labels`, True for completed points, each has a `label` (0 observed,
    1 completed) and a colour. Binary little-endian, x y z in the type of `points`
    (float32 or float64).
    """
    scalar = "f8" if points.dtype == np.float64 else "f4"
    marks = () if labels is None else ("label", "red", "green", "blue")
    fields = [(axis, scalar) for axis in _AXES] + [(name, "u1") for name in marks]
    vertices = np.empty(len(points), fields)
    for axis, column in zip(_AXES, points.T, strict=True):
        vertices[axis] = column
    if labels is not None:
        vertices["label"] = labels
        palette = np.array([COLORS[OBSERVED], COLORS[COMPLETED]], dtype=np.uint8)
        for name, shades in zip(marks[1:], palette.T, strict=True):
            vertices[name] = shades[vertices["label"]]
    comments = ["label 0: observed, 1: completed"] if marks else []
    element = plyfile.PlyElement.describe(vertices, "vertex")
    file = io.BytesIO()
    plyfile.PlyData([element], byte_order="<", comments=comments).write(file)
    return file.getvalue()


def _parse_header(data: bytes) -> tuple[plyfile.PlyData, dict[str, int], int]:
    """The header as plyfile reads it, the rows of each element by name, and where the
    body starts. plyfile is told of no rows: it takes memory for all that are claimed.
    """
    if not data.startswith(b"ply"):
        raise ValueError("it does not start with 'ply'")
    lines, counts, start = [], {}, 0
    while lines[-1:] != ["end_header"]:
        end = data.find(b"\n", start, _MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("its header has no end")
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        match words:
            case ["element", name, count] if count.isdecimal():
                counts[name] = int(count)
                lines.append(f"element {name} 0")
            case ["element", *_]:
                raise ValueError(f"its header line {' '.join(words)!r} makes no sense")
            case ["ply" | "format" | "property" | "end_header", *_]:
                lines.append(" ".join(words))
            case _:
                lines.append("comment")  # plyfile numbers the lines
    if not counts.get("vertex"):
        raise ValueError("it holds no vertices")
    text = "\n".join([*lines, ""]).encode()
    return plyfile.PlyData.read(io.BytesIO(text)), counts, start


def _vertex_row(header: plyfile.PlyData) -> np.dtype:
    """What is stored for a vertex."""
    row = header["vertex"].dtype(header.byte_order)
    if not set(_AXES) <= set(row.names or ()):
        names = ", ".join(row.names or ()) or "nothing"
        raise ValueError(f"its vertices have {names}, not x y z")
    if row.hasobject:
        raise ValueError("its vertices have list properties")
    return row


def _skip(
    data: bytes, start: int, element: plyfile.PlyElement, count: int, order: str
) -> int:
    """Where the rows of a binary element end. Its lists are of any length."""
    lists, fixed = [], 0  # for each list: what leads up to its values, and their size
    for prop in element.properties:
        size = np.dtype(prop.val_dtype).itemsize
        if not isinstance(prop, plyfile.PlyListProperty):
            fixed += size
            continue
        length = np.dtype(prop.len_dtype)
        if length.kind == "f":
            raise ValueError(f"its list {prop.name!r} has a length that is no integer")
        lists.append((struct.Struct(f"{order}{fixed}x{length.char}"), size))
        fixed = 0
    if not lists:
        return start + count * fixed
    try:
        for _ in range(count):
            for head, size in lists:
                (length,) = head.unpack_from(data, start)
                if length < 0:
                    raise ValueError("it has a list of negative length")
                start += head.size + length * size
            start += fixed
    except struct.error:
        raise ValueError(_SHORT) from None
    return start
