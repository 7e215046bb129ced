"""Point clouds as lines of numbers: XYZ, TXT and CSV."""

import io
import itertools
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Float

from prism_jax.io.errors import StrPath
from prism_jax.io.files import MAX_POINTS, check_count, read_bytes, unsound

_REMEDY = "write one point per line as 'x y z' or 'x,y,z'"
_FOREIGN = re.compile(rb"[-+]?(nan\(\w*\)|1[.,]#\w+)", re.IGNORECASE)
"""NaN and infinity as some C libraries write them: -nan(ind), 1.#QNAN, 1.#INF."""


def read_text(path: StrPath, max_points: int = MAX_POINTS) -> Float[np.ndarray, "N 3"]:
    """Positions, float64, from lines of numbers with commas, semicolons, tabs or blanks
    between them; blank lines and those that start with '#' or '//' are skipped.

    Columns are named by a first line of words, or by a comment before the first point
    with as many words as there are columns, if x, y and z are among the words;
    otherwise the first three are taken. Lines of different widths, a header of other
    columns, and more than `max_points` lines raise an InputError.
    """
    data = plain_numbers(read_bytes(path))
    try:
        check_count(max(data.count(b"\n"), data.count(b"\r")), max_points, "lines")
        text = io.StringIO(data.decode("utf-8-sig"), newline=None)
        lines = [line for line in map(str.rstrip, text) if line]
        rows = [line for line in lines if not _is_comment(line)]
        if not rows:
            raise ValueError("no points")
        delimiter = next((mark for mark in ",;\t" if mark in rows[0]), None)
        before = list(itertools.takewhile(_is_comment, lines))
        columns, has_header = _columns(before, rows, delimiter)
        points = itertools.islice(rows, int(has_header), None)
        return parse_rows(points, columns, delimiter=delimiter)
    except ValueError as error:
        raise unsound(path, "a valid table of points", error, _REMEDY) from None


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        table = np.loadtxt(
            lines,
            usecols=columns,
            max_rows=count,
            delimiter=delimiter,
            comments=None,
            encoding="ascii",
            ndmin=2,
        )
    if len(table) == 0 or (count is not None and len(table) < count):
        raise ValueError(f"ends after {len(table)} of {count or 'the'} points")
    return table


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "//"))


def _columns(
    comments: Sequence[str], rows: Sequence[str], delimiter: str | None
) -> tuple[list[int], bool]:
    """Which columns are x, y, z, and whether the first line that is no comment is a
    header."""

    def names(line: str) -> list[str]:
        return [word.strip(" \"'\t").lower() for word in line.split(delimiter)]

    words = names(rows[0])
    try:
        _ = [float(word) for word in words[:3]]
        has_header = False
    except ValueError:
        has_header = True
    widths = {len(row.split(delimiter)) for row in rows[int(has_header) :]}
    if len(widths) > 1:
        raise ValueError(f"lines have {min(widths)} to {max(widths)} columns")
    headers = [names(line.lstrip().lstrip("#/")) for line in comments]
    headers = [header for header in headers if {len(header)} == widths]
    if has_header:
        headers.append(words)
    for header in reversed(headers):
        if all(axis in header for axis in "xyz"):
            if widths and {len(header)} != widths:
                fault = f"header names {len(header)} columns, lines have {widths.pop()}"
                raise ValueError(fault)
            return [header.index(axis) for axis in "xyz"], has_header
    if has_header and len(words) > 3:
        raise ValueError(f"columns {', '.join(words)} are not named x, y and z")
    return [0, 1, 2], has_header
