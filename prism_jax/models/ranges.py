"""Types and ranges of a configuration's fields, checked when it is made."""

import dataclasses
from types import UnionType
from typing import Any, Literal, get_args, get_origin

Range = tuple[int | float, int | float]

MAX_LENGTH = 8
"""Of a tuple of any length: resolutions, stages and blocks are few."""


def check_ranges(config: Any, **ranges: Range) -> None:
    """Raises a ValueError that names the first field of a wrong type or value.

    Fields are numbers, words of a `Literal`, switches, inner configurations, tuples of
    these, or one of them or None. ``ranges`` are the least and the greatest value of
    each field of numbers, or of all numbers in a field of tuples. Numbers must be
    finite.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        fault = _fault(value, field.type, ranges.get(field.name, (0, 0)))
        if fault:
            name = f"{type(config).__name__}.{field.name}"
            raise ValueError(f"{name} must be {fault}, not {str(value)[:50]}")


def _fault(value: Any, kind: Any, within: Range) -> str:
    """What the value should be, or nothing if it is."""
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        if not isinstance(value, tuple):
            return "a tuple"
        if kinds[-1] is Ellipsis:
            if not 1 <= len(value) <= MAX_LENGTH:
                return f"a tuple of 1 to {MAX_LENGTH}"
            kinds = kinds[:1] * len(value)
        if len(value) != len(kinds):
            return f"a tuple of {len(kinds)}"
        faults = (_fault(*pair, within) for pair in zip(value, kinds, strict=True))
        return next(filter(None, faults), "")
    if get_origin(kind) is UnionType:
        if value is None:
            return ""
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        words = get_args(kind)
        return "" if value in words else f"one of {', '.join(words)}"
    if kind not in (int, float):
        return "" if isinstance(value, kind) else f"a {kind.__name__}"
    is_number = isinstance(value, int if kind is int else int | float)
    if is_number and not isinstance(value, bool) and within[0] <= value <= within[1]:
        return ""
    name = "a whole number" if kind is int else "a number"
    return f"{name} from {within[0]:g} to {within[1]:g}"
