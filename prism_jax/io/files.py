"""Bytes of a user's file within limits; the folder of what can be made again."""

import contextlib
import functools
import json
import os
import pathlib
import re
import stat
import tempfile
import warnings
from collections.abc import Iterator
from typing import Any

import yaml

from prism_jax.io.errors import InputError, StrPath, to_stderr, unreadable

CACHE_VARIABLE = "PRISM_JAX_CACHE"

MAX_FILE_BYTES = 2**30  # larger files are refused

MAX_POINTS = 10_000_000
"""Clouds and images with more points or pixels are refused, unless the caller allows
more: such a cloud is a survey, not one scan."""


class TooManyError(ValueError):
    """A file claims more points than are allowed."""


def check_count(count: int, max_points: int, what: str = "points") -> None:
    """Raise a TooManyError if there are more than `max_points`."""
    if count > max_points:
        raise TooManyError(f"{count:,} {what} exceed the limit of {max_points:,}")


@contextlib.contextmanager
def parsing(
    path: StrPath, kind: str, remedy: str, faults: type[Exception] = ValueError
) -> Iterator[None]:
    """Makes an InputError of what a parser raises, and drops what it warns of."""
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except TooManyError as error:
        remedy = "crop or thin it, or raise --max_points"
        raise InputError(path, str(error), remedy) from None
    except faults as error:
        told = error.fault if isinstance(error, InputError) else str(error)
        told = f"missing {told}" if isinstance(error, KeyError) else told
        raise InputError(path, f"not {kind}: {told}", remedy) from None


def read_bytes(path: StrPath) -> bytes:
    """All bytes of a regular file; InputError where it cannot be read, is empty, or is
    too large."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise InputError(path, "not a file", "give a file")
        if status.st_size > MAX_FILE_BYTES:
            fault = f"{status.st_size / 2**30:.1f} GiB is too large"
            remedy = f"crop or thin it to under {MAX_FILE_BYTES // 2**30} GiB"
            raise InputError(path, fault, remedy)
        data = pathlib.Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(path, "no such file", "check the path") from None
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None
    if not data:
        raise InputError(path, "empty file", "export the file again")
    return data


def read_json(path: StrPath, remedy: str) -> dict[str, Any]:
    """The JSON object that a file holds or, by its suffix, the first document of YAML,
    as ROS and OpenCV write cameras. InputError, with the remedy, where it holds
    anything else, and as for `read_bytes`."""
    data = read_bytes(path)
    kind = "YAML" if pathlib.Path(path).suffix.lower() in (".yaml", ".yml") else "JSON"
    with parsing(path, kind, remedy, Exception):
        content = _read_yaml(data) if kind == "YAML" else json.loads(data)
        if type(content) is not dict:
            raise ValueError(f"a {type(content).__name__}, not an object")
    return {str(key): value for key, value in content.items()}


def _read_yaml(data: bytes) -> Any:
    # OpenCV's first line and tags are no YAML, and 1e-05 is no number there.
    data = re.sub(rb"\A%YAML:.*\n|!!opencv-matrix", b"", data)
    data = re.sub(rb"(?<![\w.])(\d+)(?=[eE][-+]\d)", rb"\1.0", data)
    # Of deep nesting libyaml makes an error, and PyYAML's own parser takes minutes.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    # What is large takes long, and an alias may stand for any amount.
    kinds = map(type, yaml.scan(data[: 2**16], loader))
    if len(data) > 2**16 or yaml.AliasToken in kinds:
        raise ValueError("larger than 64 kB, or with an alias")
    return next(yaml.load_all(data, loader), None)


def default_cache_dir() -> pathlib.Path:
    """$PRISM_JAX_CACHE, else prism_jax in $XDG_CACHE_HOME or in ~/.cache. Where a user
    has no home, a temporary folder of this process, and a line on stderr says so."""
    if os.environ.get(CACHE_VARIABLE):
        return pathlib.Path(os.environ[CACHE_VARIABLE])
    root = os.environ.get("XDG_CACHE_HOME")
    try:
        return pathlib.Path(root or pathlib.Path.home() / ".cache") / "prism_jax"
    except RuntimeError:  # neither $HOME nor an entry in the password file
        return pathlib.Path(_temporary_cache().name)


@functools.cache
def _temporary_cache() -> tempfile.TemporaryDirectory:
    """Removed when the process ends. Its name cannot be guessed, so that nobody else
    can put compiled programs there."""
    folder = tempfile.TemporaryDirectory(prefix="prism_jax_")
    line = f"no home directory: compiled programs are not cached ({folder.name} is "
    to_stderr(f"{line}removed at exit); set {CACHE_VARIABLE} to a folder")
    return folder


def remove_temporary_cache() -> None:
    """For a process that ends without Python's help."""
    if _temporary_cache.cache_info().currsize:
        _temporary_cache().cleanup()
