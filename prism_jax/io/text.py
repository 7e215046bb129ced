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
    """Positions, float64, from lines of numbers parted by blanks, commas or semicolons.

    Blank lines and those that start with '#' or '//' are skipped. A first line of
    words names the columns: x, y and z are looked up there; without one, or if it does
    not name them, they are the first three. 'nan' and 'inf' are kept. A line that does
    not fit raises an InputError.
    """
    data = read_bytes(path)
    try:
        lines = data.decode("utf-8-sig").splitlines()
        rows = [line for line in lines if line.strip() and not _is_comment(line)]
        if not rows:
            raise ValueError("it holds no points")
        delimiter = next((mark for mark in ",;" if mark in rows[0]), None)
        columns, has_header = _columns(rows[0].split(delimiter))
        return parse_rows(
            itertools.islice(rows, int(has_header), None), columns, delimiter=delimiter
        )
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


def _columns(words: list[str]) -> tuple[list[int], bool]:
    """Which columns are x, y, z, and whether the line is a header."""
    try:
        _ = [float(word) for word in words[:3]]
        return [0, 1, 2], False
    except ValueError:
        names = [word.strip(" \"'\t").lower() for word in words]
        if all(axis in names for axis in "xyz"):
            return [names.index(axis) for axis in "xyz"], True
        return [0, 1, 2], True
