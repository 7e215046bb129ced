"""Point clouds as lines of numbers: XYZ, TXT and CSV."""

import itertools
import os
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from prism_jax.io.errors import InputError
from prism_jax.io.files import read_bytes

_REMEDY = "write one point a line as 'x y z' or 'x,y,z'"


def read_text(path: str | os.PathLike) -> Float[np.ndarray, "N 3"]:
    """Positions, float64, from lines of numbers parted by commas, semicolons, tabs or
    blanks.

    Blank lines and those that start with '#' or '//' are skipped. A first line of
    words, or a comment before the first point that has as many words as there are
    columns, names the columns, if it has x, y and z among them: they are looked up
    there. Without such a line they are the first three. 'nan' and 'inf' are kept. A
    first line of words that names more than three columns, and not these, or more or
    fewer columns than the points have, raises an InputError; so does a line that does
    not fit, or has another number of columns than the others.
    """
    data = read_bytes(path)
    try:
        lines = [line.rstrip() for line in data.decode("utf-8-sig").splitlines()]
        lines = [line for line in lines if line]
        rows = [line for line in lines if not _is_comment(line)]
        if not rows:
            raise ValueError("it holds no points")
        delimiter = next((mark for mark in ",;\t" if mark in rows[0]), None)
        before = list(itertools.takewhile(_is_comment, lines))
        columns, has_header = _columns(before, rows, delimiter)
        points = itertools.islice(rows, int(has_header), None)
        return parse_rows(points, columns, delimiter=delimiter)
    except ValueError as error:
        raise InputError(path, f"is not a table of points: {error}", _REMEDY) from None


def parse_rows(
    lines: Iterable[str] | Iterable[bytes],
    columns: Sequence[int],
    count: int | None = None,
    delimiter: str | None = None,
) -> Float[np.ndarray, "N C"]:
    """The chosen columns of lines of numbers, at most `count` lines, as float64.

    A line without these numbers, fewer lines than `count`, or none raise a ValueError.
    """
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
        raise ValueError(f"it ends after {len(table)} of {count or 'its'} points")
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
        raise ValueError(f"its lines have {min(widths)} to {max(widths)} columns")
    headers = [names(line.lstrip().lstrip("#/")) for line in comments]
    headers = [header for header in headers if {len(header)} == widths]
    if has_header:
        headers.append(words)
    for header in reversed(headers):
        if all(axis in header for axis in "xyz"):
            if widths and {len(header)} != widths:
                fault = f"it names {len(header)} columns and has {widths.pop()}"
                raise ValueError(fault)
            return [header.index(axis) for axis in "xyz"], has_header
    if has_header and len(words) > 3:
        raise ValueError(f"its columns {', '.join(words)} are not named x, y and z")
    return [0, 1, 2], has_header
