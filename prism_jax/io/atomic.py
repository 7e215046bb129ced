"""Files that are written whole or not at all."""

import os
import pathlib
import tempfile

from prism_jax.io.errors import InputError


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write a file so that its name never stands for half of it.

    The bytes go to a temporary file in the same directory, are flushed to the disk,
    and the file is then renamed over `path`. What was there stays until that moment,
    and stays for good if anything fails: an OSError becomes an InputError.
    """
    path = pathlib.Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            with open(temporary, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        _sync_directory(path.parent)
    except OSError as error:
        raise InputError(
            path,
            f"cannot be written ({error.strerror})",
            "name another place, or free some space",
        ) from None


def make_output_dir(path: str | os.PathLike) -> pathlib.Path:
    """Create a directory if need be, and prove that files can be written in it.

    Called before hours of work rather than after. Where it cannot be, an InputError.
    """
    directory = pathlib.Path(path)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return directory
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            path,
            f"cannot be written to ({reason})",
            "name a directory in which you may create files",
        ) from None


def _sync_directory(directory: pathlib.Path) -> None:
    """Flush the rename itself; a file system that cannot is no reason to fail."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError:
        pass
    finally:
        os.close(descriptor)
