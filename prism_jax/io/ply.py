"""PLY point clouds: the vertices of any PLY file, and clouds written back.

The format is Greg Turk's, "The PLY Polygon File Format" (1994). trimesh reads it too,
but needs every list of a binary element to be equally long, which a range grid's are
not, and returns doubles whatever the file holds.
"""

import dataclasses
import io
import itertools
import os

import numpy as np
from jaxtyping import Bool, Float

from prism_jax.io import atomic
from prism_jax.io.arrays import stack_columns
from prism_jax.io.errors import InputError
from prism_jax.io.files import read_bytes
from prism_jax.io.text import parse_rows

OBSERVED, COMPLETED = 0, 1
"""Values of the `label` property."""

COLORS = {OBSERVED: (37, 99, 175), COMPLETED: (230, 126, 34)}

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_AXES = ("x", "y", "z")
_MAX_HEADER_BYTES = 2**20
_REMEDY = "export it again as a PLY point cloud"
_SHORT = "it is shorter than its header says"


@dataclasses.dataclass
class _Element:
    """`properties` are (name, value type, count type; the last None unless a list)."""

    name: str
    count: int
    properties: list[tuple[str, np.dtype, np.dtype | None]]

    @property
    def stored_types(self) -> list[np.dtype]:
        return [value for name, value, _ in self.properties if name in _AXES]

    @property
    def has_lists(self) -> bool:
        return any(count_type for _, _, count_type in self.properties)

    @property
    def least_row_bytes(self) -> int:
        return sum((c or v).itemsize for _, v, c in self.properties)


def read_ply(path: str | os.PathLike) -> Float[np.ndarray, "N 3"]:
    """Vertex positions as stored: float32 where the file says float, else float64.

    ASCII and binary of either byte order; other elements, before or after, with lists
    of any length, are skipped. Rows that are not finite are kept. A malformed or cut
    file raises an InputError; a header's claims are checked against the file's size
    before anything is allocated.
    """
    data = read_bytes(path)
    try:
        layout, elements, start = _parse_header(data)
        vertex = _vertex_element(elements)
        before = list(itertools.takewhile(lambda e: e is not vertex, elements))
        if layout == "ascii":
            return _ascii_vertices(data[start:], before, vertex)
        return _binary_vertices(data, start, before, vertex)
    except ValueError as error:
        raise InputError(path, f"is not a sound PLY file: {error}", _REMEDY) from None


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
    scalar = "double" if points.dtype == np.float64 else "float"
    colors = () if labels is None else ("red", "green", "blue")
    marks = () if labels is None else ("label", *colors)
    fields = [(axis, f"<{_TYPES[scalar]}") for axis in _AXES]
    vertices = np.empty(len(points), [*fields, *((name, "u1") for name in marks)])
    for column, axis in enumerate(_AXES):
        vertices[axis] = points[:, column]
    if labels is not None:
        vertices["label"] = labels
    palette = np.array([COLORS[OBSERVED], COLORS[COMPLETED]], dtype=np.uint8)
    for channel, name in enumerate(colors):
        vertices[name] = palette[vertices["label"], channel]
    comment = ["comment label 0: observed, 1: completed"] if marks else []
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *comment,
        f"element vertex {len(points)}",
        *[f"property {scalar} {axis}" for axis in _AXES],
        *[f"property uchar {name}" for name in marks],
        "end_header\n",
    ]
    return "\n".join(header).encode() + vertices.tobytes()


def _parse_header(data: bytes) -> tuple[str, list[_Element], int]:
    """The format's name, the elements in file order, and where the body starts."""
    layout, elements, start = "", [], 0
    if not data.startswith(b"ply"):
        raise ValueError("it does not start with 'ply'")
    while True:
        end = data.find(b"\n", start, _MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("its header has no end")
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        match words:
            case ["end_header"]:
                break
            case ["format", layout, _] if layout not in _FORMATS:
                raise ValueError(f"its format {layout!r} is unknown")
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count_type, value_type, name] if elements:
                value, count = _dtype(value_type, layout), _dtype(count_type, layout)
                if count.kind == "f":
                    raise ValueError(
                        f"its list {name!r} has a length that is no integer"
                    )
                elements[-1].properties.append((name, value, count))
            case ["property", value_type, name] if elements:
                elements[-1].properties.append((name, _dtype(value_type, layout), None))
            case ["element" | "property", *_]:
                raise ValueError(f"its header line {' '.join(words)!r} makes no sense")
    if not layout:
        raise ValueError("its header names no format")
    return layout, elements, start


def _dtype(name: str, layout: str) -> np.dtype:
    if name not in _TYPES:
        raise ValueError(f"its header names an unknown type {name!r}")
    return np.dtype(_FORMATS.get(layout, "=") + _TYPES[name])


def _vertex_element(elements: list[_Element]) -> _Element:
    vertex = next((e for e in elements if e.name == "vertex"), None)
    if vertex is None or vertex.count == 0:
        raise ValueError("it holds no vertices")
    names = [name for name, _, _ in vertex.properties]
    if any(names.count(axis) != 1 for axis in _AXES):
        raise ValueError(
            f"its vertices have {', '.join(names) or 'nothing'}, not x y z"
        )
    if vertex.has_lists:
        raise ValueError("its vertices have list properties")
    return vertex


def _ascii_vertices(body: bytes, before: list[_Element], vertex: _Element):
    rows = (line for line in io.BytesIO(body) if not line.isspace())
    skipped = sum(element.count for element in before if element.properties)
    if skipped + vertex.count > len(body):
        raise ValueError(_SHORT)
    columns = [name for name, _, _ in vertex.properties]
    points = parse_rows(
        itertools.islice(rows, skipped, None),
        columns=[columns.index(axis) for axis in _AXES],
        count=vertex.count,
    )
    return stack_columns(points.T, vertex.stored_types)


def _binary_vertices(data: bytes, start: int, before: list[_Element], vertex: _Element):
    for element in before:
        start = _skip(data, start, element)
    row = np.dtype([(name, value) for name, value, _ in vertex.properties])
    if vertex.count * row.itemsize > len(data) - start:
        raise ValueError(_SHORT)
    rows = np.frombuffer(data, dtype=row, count=vertex.count, offset=start)
    return stack_columns([rows[axis] for axis in _AXES], vertex.stored_types)


def _skip(data: bytes, start: int, element: _Element) -> int:
    """Where the element's rows end."""
    if element.count * element.least_row_bytes > len(data) - start:
        raise ValueError(_SHORT)
    if not element.has_lists:
        return start + element.count * element.least_row_bytes
    for _ in range(element.count):
        for _, value_type, count_type in element.properties:
            if count_type is None:
                start += value_type.itemsize
                continue
            head = data[start : start + count_type.itemsize]
            if len(head) < count_type.itemsize:
                raise ValueError(_SHORT)
            length = int(np.frombuffer(head, count_type)[0])
            if length < 0:
                raise ValueError("it has a list of negative length")
            start += count_type.itemsize + length * value_type.itemsize
    return start
