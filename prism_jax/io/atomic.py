"""Files that are written whole or not at all."""

import contextlib
import glob
import os
import pathlib
import shutil
import tempfile
import uuid
from collections.abc import Iterable, Mapping
from typing import Any

from prism_jax.io.errors import InputError, StrPath, unwritable

_REPORTS = (".html", "calibration.json", "stream.json")  # in no folder an input
_KEPT: list[str] = []
_CLAIMED: dict[str, int] = {}  # folders and their descriptors


def keep(paths: Iterable[StrPath]) -> None:
    """From now on these files, those in folders with recorded frames below them, and
    images' cameras are kept."""
    _KEPT.clear()
    for path in (os.path.abspath(path) for path in paths):
        root = glob.escape(path)
        inside = glob.glob(f"{root}/*") + glob.glob(f"{root}/*/[0-9]*.*.*")
        beside = [path[:-4] + ".json"] if path.lower().endswith(".png") else []
        _KEPT.extend([path, *(p for p in inside if not p.endswith(_REPORTS)), *beside])


def check_targets(paths: Iterable[StrPath], folders: bool = False) -> None:
    """InputError if a path is a file to `keep`, however it is spelled, a folder where
    none is expected, or too long a name. For what takes long, before it starts."""
    for path in paths:
        try:
            os.stat(path)
        except FileNotFoundError:
            continue
        except OSError as error:
            raise unwritable(path, error) from None
        if _is_kept(path):
            raise InputError(path, "this is an input", "choose another output")
        if os.path.isdir(path) and not folders:
            raise unwritable(path, IsADirectoryError("is a folder"))


def _is_kept(path: StrPath) -> bool:
    inodes = {os.stat(kept)[1:3] for kept in _KEPT if os.path.exists(kept)}
    return os.stat(path)[1:3] in inodes


def aside(path: StrPath, suffix: str = ".tmp") -> pathlib.Path:
    """A hidden name that nothing else has, for a file until it is whole."""
    place = pathlib.Path(path)
    return place.with_name(f".{place.stem[:32]}.{uuid.uuid4().hex}{suffix}")


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
    check_targets(named)
    temporaries = {path: aside(path) for path in named}
    current = pathlib.Path()
    try:
        with contextlib.ExitStack() as stack:
            for current, data in named.items():
                stack.callback(temporaries[current].unlink, missing_ok=True)
                with open(temporaries[current], "xb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
            for current, temporary in temporaries.items():
                os.replace(temporary, current)
            for directory in {path.parent for path in named}:
                # A file system that cannot flush the renames is no reason to fail.
                with contextlib.suppress(OSError):
                    descriptor = os.open(directory, os.O_RDONLY)
                    stack.callback(os.close, descriptor)
                    os.fsync(descriptor)
    except OSError as error:
        raise unwritable(current, error) from None


PREVIOUS = "previous"  # the folder for what an earlier run wrote


def set_aside(folder: StrPath, names: Iterable[str]) -> bool:
    """Moves what an earlier run wrote in a folder into `PREVIOUS`, in the place of what
    is there, and says whether there was anything. `names` may be patterns."""
    place = pathlib.Path(folder)
    found = [path for name in names for path in place.glob(name)]
    inside = [p for path in (*found, place / PREVIOUS) for p in path.rglob("*")]
    check_targets([*found, *inside], folders=True)
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
    for path in pathlib.Path(folder).glob(f".*.{mark}.*"):
        if not _is_kept(path):
            path.unlink(missing_ok=True)


def claim(path: StrPath) -> pathlib.Path:
    """`make_output_dir` for this process alone, until it claims one beside it or ends;
    others get an InputError. What killed ones left there is removed. Both only where
    the system can lock a folder."""
    folder = make_output_dir(path)
    real = os.path.realpath(folder)
    for other in _CLAIMED.keys() - {real, os.path.dirname(real)}:
        os.close(_CLAIMED.pop(other))
    with contextlib.suppress(ImportError, OSError):
        import fcntl

        if real not in _CLAIMED:
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                remedy = "wait for its end, or choose another output"
                raise InputError(path, "another process writes here", remedy) from None
            _CLAIMED[real] = descriptor
        remove_unfinished(folder)
    return folder


def make_output_dir(path: StrPath) -> pathlib.Path:
    """Create a directory if need be, and prove that files can be written in it. Called
    before hours of work rather than after. Where it cannot be, an InputError."""
    directory = pathlib.Path(path)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return directory
    except (OSError, ValueError) as error:
        raise unwritable(path, error) from None
