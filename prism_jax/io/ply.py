"""PLY point clouds: the vertices of any PLY file, and clouds written back.

The format is Greg Turk's, "The PLY Polygon File Format" (1994).
"""

import itertools
import re
import struct
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from prism_jax.io.arrays import Fields, stack_columns
from prism_jax.io.errors import StrPath
from prism_jax.io.files import MAX_POINTS, check_count, parsing, read_bytes
from prism_jax.io.text import body_lines, header_lines, parse_rows

OBSERVED, COMPLETED, KNOWN = 0, 1, 2
"""Values of the `label` property; a known robot's surface is `KNOWN`."""

OBJECTS = "object -1: support or wall, -2: none, else the object's number"

SIGMA = "sigma: expected distance from the true surface, 0 for observed points"

COLORS = {OBSERVED: (37, 99, 175), COMPLETED: (230, 126, 34), KNOWN: (120, 94, 160)}

_FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
# Types as PLY names them, in the order in which ROS counts them from 1.
NUMBERS = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort"}
NUMBERS |= {"i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
_TYPES = {name: code for code, name in NUMBERS.items()}
_TYPES |= {np.dtype(code).name: code for code in (*NUMBERS, "i8", "u8")}
_TYPES |= {"bool": "u1", "long": "i8", "ulong": "u8"}
_SHORT = "the file is truncated"
_REMEDY = "export it again as a PLY point cloud"


def read_ply(
    path: StrPath, max_points: int = MAX_POINTS, fields: Fields | None = None
) -> Float[np.ndarray, "N 3"]:
    """Vertex positions as stored: float32 where the file says float, else float64.
    `fields` gets the vertices' other properties but lists.

    Elements before the vertices are skipped; what comes after is not looked at. Rows
    that are not finite are kept. A malformed or cut file, and one of more than
    `max_points` vertices or rows before them, raise an InputError.
    """
    data = read_bytes(path)
    with parsing(path, "a valid PLY file", _REMEDY):
        layout, elements, start = _parse_header(data)
        before = list(itertools.takewhile(lambda e: e.name != "vertex", elements))
        vertex, places = _vertices(elements)
        if fields is not None:
            kinds = enumerate(vertex.properties)
            kept = [i for i, p in kinds if p.length is None and p.value.kind != "V"]
            places += [i for i in kept if i not in places]
        check_count(vertex.count, max_points)
        check_count(sum(e.count for e in before), max_points, "rows before vertices")
        if layout == "ascii":
            skipped = sum(element.count for element in before if element.properties)
            lines = itertools.islice(body_lines(data[start:]), skipped, None)
            if vertex.has_lists:
                lines = (_without_lists(line, vertex) for line in lines)
            columns = parse_rows(lines, places, vertex.count).T
        else:
            for element in before:
                start = _skip(data, start, element)
            columns = _columns(data, start, vertex, places)
        names, stored, _ = zip(*(vertex.properties[i] for i in places), strict=True)
        return stack_columns(columns, stored, names[3:], fields)


def num_faces(path: StrPath) -> int:
    """How many faces a PLY file says that it has, after its vertices."""
    _, elements, _ = _parse_header(read_bytes(path))
    return sum(element.count for element in elements if element.name == "face")


def ply_bytes(
    points: Float[np.ndarray, "M 3"],
    labels: Bool[np.ndarray, " M"] | UInt8[np.ndarray, " M"] | None = None,
    objects: Int[np.ndarray, " M"] | None = None,
    sigma: Float[np.ndarray, " M"] | None = None,
    fields: Fields | None = None,
) -> bytes:
    """A file of points, which `read_ply` reads back bit for bit: binary little-endian,
    x y z in the type of `points`. With `labels` (True for completed points, or 0 to 2),
    each has a `label` and a colour; with `objects` too, the number of an `object`; with
    `sigma`, a float32 of that name.

    `fields` are what the first points have beside that; on the others they are NaN, or
    0 if integers. Colours that PCD and ROS pack into 32 bits are a byte each. If they
    have colours, ours are `label_red` and so on; what they have
    under another of the names above is `input_label` and so on."""
    columns, fields = {}, _unpacked(fields or {})
    comments = []
    if labels is not None:
        palette = np.array(list(COLORS.values()), dtype=np.uint8)
        label = labels.astype(np.uint8)
        columns["label"] = label
        names = "red", "green", "blue"
        own = "label_" if {*names} & {*fields} else ""
        columns |= zip([own + name for name in names], palette[label].T, strict=True)
        known = ", 2: known" if (label == KNOWN).any() else ""
        comments.append(f"label 0: observed, 1: completed{known}")
    if objects is not None:
        columns["object"] = objects.astype(np.int32)
        comments.append(OBJECTS)
    if sigma is not None:
        columns["sigma"] = sigma.astype(np.float32)
        comments.append(SIGMA)
    columns |= (found := of_first(fields, len(points), {*columns, *"xyz"}))
    if found:
        comments.append(f"of the input, nan or 0 on other points: {', '.join(found)}")
    return vertices_bytes(points, columns, comments)


def _unpacked(fields: Fields) -> Fields:
    """Fields with what is packed as 0xAARRGGBB in bytes of their own."""
    found: Fields = {}
    for name, column in fields.items():
        found[name] = column
        if name in ("rgb", "rgba") and column.dtype.itemsize == 4:
            parts = np.ascontiguousarray(found.pop(name)).view(np.uint8).reshape(-1, 4)
            colors = ("red", "green", "blue", "alpha")[: len(name)]
            found |= zip(colors, parts.T[[2, 1, 0, 3]], strict=False)
    return found


def of_first(fields: Fields, count: int, taken: Collection[str]) -> Fields:
    """Columns for so many points, of which the first have these fields. On the others
    they are NaN, or 0 if integers. One of a name that is taken is `input_...`."""
    found: Fields = {}
    for name, column in fields.items():
        name = re.sub("[^!-~]", "_", name)  # one word
        while name in found or name in taken:
            name = f"input_{name}"
        kind = column.dtype if column.dtype.str[1:] in NUMBERS else np.dtype(float)
        found[name] = np.full(count, np.nan if kind.kind == "f" else 0, kind)
        found[name][: len(column)] = column
    return found


def vertices_bytes(
    points: Float[np.ndarray, "M 3"],
    columns: Mapping[str, np.ndarray] | None = None,
    comments: Sequence[str] = (),
) -> bytes:
    """A file of points with further properties: a column of numbers each, by name.
    Binary little-endian; x y z in the type of `points` (float32 or float64), columns in
    theirs. Comments are lines of the header."""
    scalar = np.float64 if points.dtype == np.float64 else np.float32
    table = dict(zip("xyz", points.astype(scalar).T, strict=True)) | (columns or {})  # pyright: ignore
    kinds = [(name, f"<{column.dtype.str[1:]}") for name, column in table.items()]
    vertices = np.rec.fromarrays([*table.values()], dtype=kinds)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(points)}",
        *(f"property {NUMBERS[kind[1:]]} {name}" for name, kind in kinds),
        "end_header\n",
    ]
    return "\n".join(header).encode() + vertices.tobytes()


class _Property(NamedTuple):
    """One number of a row or, where ``length`` is a type, a list of them."""

    name: str
    value: np.dtype
    length: np.dtype | None = None


class _Element(NamedTuple):
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(prop.length is not None for prop in self.properties)


def _parse_header(data: bytes) -> tuple[str, list[_Element], int]:
    """The format, the elements in the file's order, and where the body starts."""
    if not data.startswith(b"ply"):
        raise ValueError("does not start with 'ply'")
    layout, elements = "", []
    lines, start = header_lines(data, "end_header", 2**18)
    for words in lines:
        match words:
            case ["format", name, *_] if name in _FORMATS:
                layout = name
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, value, name] if elements:
                kinds = _dtype(value, layout), _dtype(length, layout)
                elements[-1].properties.append(_Property(name, *kinds))
            case ["property", value, name] if elements:
                elements[-1].properties.append(_Property(name, _dtype(value, layout)))
            case ["format" | "element" | "property", *_]:
                raise ValueError(f"invalid header line {' '.join(words)!r}")
    if not layout:
        raise ValueError("no format in the header")
    return layout, elements, start


def _dtype(name: str, layout: str) -> np.dtype:
    if name not in _TYPES and layout != "ascii":
        raise ValueError(f"unknown type {name!r} in the header")
    return np.dtype(_FORMATS.get(layout, "=") + _TYPES.get(name, "V8"))


def _vertices(elements: list[_Element]) -> tuple[_Element, list[int]]:
    """The vertices, and which of their properties are x, y and z."""
    vertex = next((e for e in elements if e.name == "vertex"), None)
    if vertex is None or vertex.count == 0:
        raise ValueError("no vertices")
    names = [prop.name for prop in vertex.properties]
    if any(names.count(axis) != 1 for axis in "xyz"):
        raise ValueError(f"vertices have {', '.join(names) or 'nothing'}, not x y z")
    places = [names.index(axis) for axis in "xyz"]
    if any(vertex.properties[place].length is not None for place in places):
        raise ValueError("x, y or z is a list")
    return vertex, places


def _without_lists(line: bytes, element: _Element) -> bytes:
    """A row of text with one word for each property, 0 for a list."""
    words, kept = iter(line.split()), []
    for prop in element.properties:
        kept.append(next(words, b""))
        if prop.length is not None:
            kept[-1], length = b"0", int(kept[-1])
            _ = list(itertools.islice(words, length))
    return b" ".join(kept)


def _columns(
    data: bytes, start: int, element: _Element, places: list[int]
) -> list[np.ndarray]:
    """Some properties of a binary element, none of them a list."""
    if element.has_lists:
        kept: list[bytes] = []
        _skip(data, start, element, kept)
        data, start = b"".join(kept), 0
    properties = enumerate(element.properties)
    row = np.dtype([(str(n), p.value) for n, p in properties if p.length is None])
    if start + element.count * row.itemsize > len(data):
        raise ValueError(_SHORT)
    rows = np.frombuffer(data, row, element.count, start)
    return [rows[str(place)] for place in places]


def _skip(
    data: bytes, start: int, element: _Element, kept: list[bytes] | None = None
) -> int:
    """Where the rows of a binary element end. Its lists are of any length; what is
    stored beside them is `kept`."""
    lists, fixed = [], 0  # for each list: what leads up to its values, and their size
    for prop in element.properties:
        if prop.length is None:
            fixed += prop.value.itemsize
            continue
        if prop.length.kind == "f":
            raise ValueError(f"length of list {prop.name!r} is not an integer")
        order = ">" if prop.length.byteorder == ">" else "<"
        head = struct.Struct(f"{order}{fixed}x{prop.length.char}")
        lists.append((fixed, head, prop.value.itemsize))
        fixed = 0
    if not lists:
        return start + element.count * fixed
    try:
        for _ in range(element.count):
            for before, head, size in lists:
                (length,) = head.unpack_from(data, start)
                if length < 0:
                    raise ValueError("negative list length")
                if kept is not None:
                    kept.append(data[start : start + before])
                start += head.size + length * size
            if kept is not None:
                kept.append(data[start : start + fixed])
            start += fixed
    except struct.error:
        raise ValueError(_SHORT) from None
    return start
