"""The settings of a run: a preset by name, and ``--set=path.to.field=value``."""

import ast
import dataclasses
from collections.abc import Sequence
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from experiments.presets import PRESETS, Preset
from prism_jax.io.errors import InputError


def resolve(name: str, changes: Sequence[str] = ()) -> Preset:
    """A preset by name with ``path.to.field=value`` changes applied.

    An unknown preset or field, or a value of another type, raises `InputError`.
    """
    if name not in PRESETS:
        known = ", ".join(PRESETS)
        raise InputError(name, "no such preset", f"use one of {known}")
    return changed(PRESETS[name], changes)


def changed(config: Any, changes: Sequence[str]) -> Any:
    """A configuration with ``path.to.field=value`` changes applied, as in `resolve`."""
    for change in changes:
        path, equals, text = change.partition("=")
        if not equals:
            raise InputError(change, "not a setting", "write path.to.field=value")
        config = _replaced(config, type(config), path.split("."), text, change)
    return config


def _replaced(config: Any, kind: Any, path: list[str], text: str, change: str) -> Any:
    if not path:
        return _value(kind, text, change)
    name, *rest = path
    parts = _parts(config, kind)
    if name not in parts:
        remedy = f"use one of {', '.join(parts)}" if parts else "omit it"
        raise InputError(change, f"no field {name!r}", remedy)
    value = _replaced(*parts[name], rest, text, change)
    if isinstance(config, tuple):
        index = int(name)
        return (*config[:index], value, *config[index + 1 :])
    try:
        return dataclasses.replace(config, **{name: value})
    except ValueError as error:
        raise InputError(change, str(error), "give a valid value") from None


def _parts(config: Any, kind: Any) -> dict[str, tuple[Any, Any]]:
    """Named parts of a dataclass, numbered ones of a tuple, none of a plain value; each
    with the type that is asked of it."""
    if isinstance(config, tuple):
        items = zip(config, _items(kind, len(config)), strict=True)
        return {str(index): item for index, item in enumerate(items)}
    if not dataclasses.is_dataclass(config):
        return {}
    kinds = get_type_hints(type(config))
    return {name: (getattr(config, name), kind) for name, kind in kinds.items()}


def _value(kind: Any, text: str, change: str) -> Any:
    """The text as a value of that type: words as they are, the rest as in Python."""
    word = get_origin(kind) is Literal
    value = text if word or kind is str else _literal(text, change)
    if kind is float and type(value) is int:
        value = float(value)
    if not _fits(value, kind):
        name = kind.__name__ if isinstance(kind, type) else str(kind)
        choice = f"one of {', '.join(get_args(kind))}" if word else f"of type {name}"
        raise InputError(change, f"not {choice}", "give a valid value")
    return value


def _literal(text: str, change: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        raise InputError(change, "not a value", "write a Python literal") from None


def _fits(value: Any, kind: Any) -> bool:
    options = get_args(kind)
    if get_origin(kind) is Literal:
        return value in options
    if get_origin(kind) is UnionType:
        return any(_fits(value, option) for option in options)
    if get_origin(kind) is not tuple:
        return type(value) is kind
    if type(value) is not tuple:
        return False
    items = _items(kind, len(value))
    return len(value) == len(items) and all(map(_fits, value, items))


def _items(kind: Any, count: int) -> tuple[Any, ...]:
    """The types of a tuple's items: of so many, where the number is open."""
    items = get_args(kind)
    return items[:1] * count if items[-1] is Ellipsis else items
