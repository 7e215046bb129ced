"""Point clouds as lines of numbers: XYZ, TXT and CSV."""

import io
import itertools
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from prism_jax.io.errors import StrPath
from prism_jax.io.files import MAX_POINTS, check_count, read_bytes, unsound

_REMEDY = "write one point per line as 'x y z' or 'x,y,z'"


def read_text(path: StrPath, max_points: int = MAX_POINTS) -> Float[np.ndarray, "N 3"]:
    """Positions, float64, from lines of numbers with commas, semicolons, tabs or blanks
    between them; blank lines and those that start with '#' or '//' are skipped.

    Columns are named by a first line of words, or by a comment before the first point
    with as many words as there are columns, if x, y and z are among the words;
    otherwise the first three are taken. Lines of different widths, a header of other
    columns, and more than `max_points` lines raise an InputError.
    """
    data = read_bytes(path)
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
