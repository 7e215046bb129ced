"""Point clouds as lines of numbers: XYZ, TXT, CSV and their like."""

import contextlib
import io
import pathlib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.io.arrays import Fields, check_not_index
from prism_jax.io.errors import StrPath
from prism_jax.io.files import MAX_POINTS, check_count, parsing, read_bytes

_REMEDY = "write one point per line as 'x y z', or name the columns in the first line"
_FOREIGN = re.compile(rb"[-+]?(nan\(\w*\)|1[.,]#([qs]nan|ind|inf)\w*)", re.IGNORECASE)
"""NaN and infinity as some C libraries write them: -nan(ind), 1.#QNAN, 1.#INF."""

_DECIMAL_COMMAS = r"\s*([-+]?\d+,\d+\s+){2}[-+]?\d+,\d"  # with blanks between them
_HEADER = r"\W*(?!(nan|inf)\b)[^\W\d_]"  # begins with a letter
_NAMES = ("%s%.0s", r"%s\d%.0s", r".*(?:xyz|points?)\W%.0s%d")
"""How columns are named x, y and z, by the letter or the number, in this order."""
_COLORS = {"r": "red", "g": "green", "b": "blue"}
_USUAL = {".xyzrgb": "x y z red green blue", ".pts": "x y z intensity red green blue"}
"""How they are named in files without a header."""


def read_text(
    path: StrPath, max_points: int = MAX_POINTS, fields: Fields | None = None
) -> Float[np.ndarray, "N C"]:
    """Positions, float64, from lines of numbers with semicolons, tabs, commas or blanks
    between them; blank lines and those that start with '#', '//' or '%' are skipped, as
    is a first line with the number of points. Commas within numbers are decimal.
    `fields` gets other columns of numbers that have names, and the cloud NaN for each
    column that is left out.

    Columns are named by a first line of words, or by a comment before the first point
    with as many words as there are columns, if x, y and z are among the words, also as
    in `X [m]`, `x1` and `Points:0`; otherwise the first three are taken, unless the
    first counts the lines. Lines of different widths, a header of other columns, and
    more than `max_points` lines raise an InputError.
    """
    data = plain_numbers(read_bytes(path))
    with parsing(path, "a valid table of points", _REMEDY):
        check_count(max(data.count(b"\n"), data.count(b"\r")), max_points, "lines")
        # With a mark it may be UTF-16. What is not Unicode is in Latin letters.
        is_wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
        try:
            text = data.decode("utf-16" if is_wide else "utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
        lines = [line.rstrip() for line in io.StringIO(text, newline=None)]
        usual = _USUAL.get(pathlib.Path(path).suffix.lower(), "")
        return _read(lines, usual, fields)


def _read(lines: Sequence[str], usual: str, fields: Fields | None) -> np.ndarray:
    """As `read_text`; a ValueError says which line is wrong."""
    marks, starts = ("#", "//", "%"), enumerate(map(str.lstrip, lines))
    places = [n for n, start in starts if start and not start.startswith(marks)]
    if not places:
        raise ValueError("no points")
    comments, rows = lines[: places[0]], [lines[n] for n in places]
    if rows[0].isdecimal() and len(rows) > 1:
        if int(rows[0]) != len(rows) - 1:
            raise ValueError(f"{rows[0]} points announced, {len(rows) - 1} found")
        del rows[0], places[0]
    some = rows[len(rows) // 2]
    delimiter = next((mark for mark in ";\t" if mark in some), None)
    if delimiter or re.match(_DECIMAL_COMMAS, some):
        rows = [row.replace(",", ".") for row in rows]
    elif "," in some:
        delimiter = ","
    first = int(re.match(_HEADER, rows[0].lower()) is not None)
    widths = [len(row.split(delimiter)) for row in rows[first:]] or [3]
    for place, width in zip(places[first:], widths, strict=False):
        if width != (needed := max(widths[0], 3)):
            raise ValueError(f"line {place + 1} has {width} columns, not {needed}")
    usual = usual.replace(" ", delimiter or " ") * (1 - first)
    columns = _named([usual, *comments, *rows[:first]], delimiter, widths[0])
    named = len(rows[0].split(delimiter)) if first and not columns else 0
    if named > 2 and (named, widths[0]) != (3, 3):
        raise ValueError(f"the header {rows[0]!r} does not name x, y and z")
    is_named = bool(columns)
    xyz = [columns.pop(axis, n) for n, axis in enumerate("xyz")]
    try:
        points = parse_rows(rows[first:], xyz, None, delimiter)
    except ValueError as error:
        row, fault = re.search(r" at row (\d+)", str(error)), str(error)
        if row:
            fault = fault.replace(row[0], f" in line {places[int(row[1]) + first] + 1}")
        raise ValueError(fault[:200].rstrip(".")) from None
    if not is_named:
        check_not_index(points[:, 0])
    if fields is None:
        return points
    for name in filter(None, columns):
        with contextlib.suppress(ValueError):  # words
            column = parse_rows(rows[first:], [columns[name]], None, delimiter)
            fields[name] = column[:, 0]
    colors = [name for name in ("red", "green", "blue") if name in fields]
    values = np.array([fields[name] for name in colors])
    if values.max(initial=0) > 1 and (values == values.astype(np.uint8)).all():
        fields |= zip(colors, values.astype(np.uint8), strict=True)
    left_out = np.full((len(points), widths[0] - 3 - len(fields)), np.nan)
    return np.hstack([points, left_out])


def plain_numbers(data: bytes) -> bytes:
    """Lines of numbers in which all that is not finite is "nan" or "inf"."""
    return _FOREIGN.sub(b"nan", data) if b"#" in data or b"(" in data else data


def body_lines(data: bytes) -> Iterator[bytes]:
    """Lines of numbers that are not blank, also where each ends in a lone CR."""
    body = io.BytesIO(plain_numbers(data.replace(b"\r", b"\n")))
    return (line for line in body if not line.isspace())


def header_lines(data: bytes, last: str, most: int) -> tuple[list[list[str]], int]:
    """The words of each line up to the one that `last` begins, and where the body
    starts; ValueError if that is not within `most` bytes. Lines end as the first one
    does, in LF, CR LF or a lone CR."""
    first = re.search(b"\r\n?|\n", data[:most])
    mark = b"\r" if first and first.group() == b"\r" else b"\n"
    lines, start = [[""]], 0
    while not lines[-1] or lines[-1][0].upper() != last.upper():
        end = data.find(mark, start, most)
        if end < 0:
            raise ValueError(f"no {last} line in the header")
        lines.append(data[start:end].decode("latin-1").split())
        start = end + 1
    return lines[1:], start


def parse_rows(
    lines: Iterable[str] | Iterable[bytes],
    columns: Sequence[int],
    count: int | None = None,
    delimiter: str | None = None,
) -> Float[np.ndarray, "N C"]:
    """The chosen columns of lines of numbers, at most `count` lines, as float64. A line
    without these numbers, fewer lines than `count`, or none raise a ValueError."""
    how: Any = {"comments": None, "encoding": "ascii", "ndmin": 2}
    how |= {"usecols": columns, "max_rows": count, "delimiter": delimiter}
    table = np.loadtxt(lines, **how)
    if len(table) == 0 or (count is not None and len(table) < count):
        raise ValueError(f"ends after {len(table)} of {count or 'the'} points")
    return table


def _named(headers: Sequence[str], delimiter: str | None, width: int) -> dict[str, int]:
    """Where the last header of so many names has x, y and z, and all others."""
    for line in reversed(headers):
        line = re.sub(r"\[[^][]*\]|\([^()]*\)", "", line).lstrip().lstrip("#/%")
        names = [word.strip(" \"'\t") for word in line.split(delimiter)]
        for form in _NAMES if len(names) == width else ():
            wanted = [f"(?i:{form % axis})" for axis in (("x", 0), ("y", 1), ("z", 2))]
            found = [[bool(re.fullmatch(w, name)) for name in names] for w in wanted]
            if all(map(any, found)):
                xyz = [matches.index(True) for matches in found]
                if {*"rgb"} <= {name.lower() for name in names}:
                    names = [_COLORS.get(name.lower(), name) for name in names]
                others = {name: n for n, name in enumerate(names) if n not in xyz}
                return others | dict(zip("xyz", xyz, strict=True))
    return {}
