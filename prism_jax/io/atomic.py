"""Files that are written whole or not at all."""

import contextlib
import os
import pathlib
import shutil
import tempfile
import uuid
from collections.abc import Iterable, Mapping
from typing import Any

from prism_jax.io.errors import InputError, StrPath, unwritable


def write_bytes(path: StrPath, data: bytes) -> None:
    """Write a file so that its name never stands for half of it (`write_together`)."""
    write_together({path: data})


def write_together(files: Mapping[Any, bytes]) -> None:
    """Write files, by their paths, of which no name ever stands for half of one.

    Only when the bytes of all are on the disk under other names, these are renamed, in
    order. An OSError becomes an InputError; one between two renames, or a kill there,
    leaves the first files new and the last as they were.
    """
    named = {pathlib.Path(path): data for path, data in files.items()}
    mark = uuid.uuid4().hex
    aside = {path: path.with_name(f".{path.name}.{mark}.tmp") for path in named}
    current = pathlib.Path()
    try:
        try:
            for current, data in named.items():
                with open(aside[current], "xb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
            for current, temporary in aside.items():
                os.replace(temporary, current)
        finally:
            for temporary in aside.values():
                temporary.unlink(missing_ok=True)
        for directory in {path.parent for path in named}:
            _sync_directory(directory)
    except OSError as error:
        raise unwritable(current, error) from None


PREVIOUS = "previous"  # the folder for what an earlier run wrote


def set_aside(folder: StrPath, names: Iterable[str]) -> bool:
    """Moves what an earlier run wrote in a folder into `PREVIOUS`, in the place of what
    is there, and says whether there was anything. `names` may be patterns."""
    place = pathlib.Path(folder)
    found = [path for name in names for path in place.glob(name)]
    try:
        if found:
            shutil.rmtree(place / PREVIOUS, ignore_errors=True)
            (place / PREVIOUS).mkdir()
        for path in found:
            os.replace(path, place / PREVIOUS / path.name)
    except OSError as error:
        raise unwritable(place / PREVIOUS, error) from None
    return bool(found)


def remove_unfinished(folder: StrPath) -> None:
    """Remove the temporary files that killed writers left in a folder. For a folder
    that has one writer, when it starts: it cannot tell a killed writer's files from
    those of another that is at work."""
    mark = "[0-9a-f]" * len(uuid.uuid4().hex)
    for path in pathlib.Path(folder).glob(f".*.{mark}.tmp"):
        path.unlink(missing_ok=True)


def make_output_dir(path: StrPath) -> pathlib.Path:
    """Create a directory if need be, and prove that files can be written in it. Called
    before hours of work rather than after. Where it cannot be, an InputError."""
    directory = pathlib.Path(path)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return directory
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        remedy = "choose a directory that you can write to"
        raise InputError(path, f"cannot be written to ({reason})", remedy) from None


def _sync_directory(directory: pathlib.Path) -> None:
    """Flush the rename itself; a file system that cannot is no reason to fail."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    with contextlib.suppress(OSError):
        os.fsync(descriptor)
    os.close(descriptor)
