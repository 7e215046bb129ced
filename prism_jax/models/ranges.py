"""Types and ranges of a configuration's fields, checked when it is made."""

import dataclasses
from collections.abc import Sequence
from types import UnionType
from typing import Annotated, Any, Literal, get_args, get_origin

MAX_LENGTH = 8  # of a tuple of any length: resolutions, stages and blocks are few


class Checked:
    """Base of configurations. ``Annotated[int, 1, 64]`` is an integer from 1 to 64.

    Fields are numbers, words of a `Literal`, switches, inner configurations, tuples of
    these, or one of them or None. A range holds for all numbers of a field. The first
    field of a wrong type or value raises a ValueError that names it.
    """

    def __post_init__(self):
        for field in dataclasses.fields(self):  # pyright: ignore
            value, kind, within = getattr(self, field.name), field.type, (0, 0)
            if get_origin(kind) is Annotated:
                kind, *within = get_args(kind)
            if fault := _fault(value, kind, within):
                name = f"{type(self).__name__}.{field.name}"
                raise ValueError(f"{name} must be {fault}, not {str(value)[:50]}")


def _fault(value: Any, kind: Any, within: Sequence[int | float]) -> str:
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
    name = "an integer" if kind is int else "a number"
    return f"{name} from {within[0]:g} to {within[1]:g}"
