"""Bytes of a user's file, or an InputError; the folder of what can be made again."""

import os
import pathlib
import stat

from prism_jax.io.errors import InputError

CACHE_VARIABLE = "PRISM_JAX_CACHE"

MAX_FILE_BYTES = 2**30
"""Larger files are refused: some 40 million points are a survey, not one scan."""


def read_bytes(path: str | os.PathLike) -> bytes:
    """All bytes of a regular file.

    A file that is missing, empty, too large, not a file or not readable raises an
    InputError.
    """
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise InputError(path, "is not a file", "name a file")
        if status.st_size > MAX_FILE_BYTES:
            raise InputError(
                path,
                f"holds {status.st_size / 2**30:.1f} GiB",
                f"crop or thin it to under {MAX_FILE_BYTES // 2**30} GiB",
            )
        data = pathlib.Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(path, "no such file", "check the path") from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            path, f"cannot be read ({reason})", "check the path and its permissions"
        ) from None
    if not data:
        raise InputError(path, "is empty", "write the file again at its source")
    return data


def default_cache_dir() -> pathlib.Path:
    """$PRISM_JAX_CACHE, else prism_jax in $XDG_CACHE_HOME or in ~/.cache."""
    if CACHE_VARIABLE in os.environ:
        return pathlib.Path(os.environ[CACHE_VARIABLE])
    root = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(root) / "prism_jax"
