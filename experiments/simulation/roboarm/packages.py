"""Where the robots of installed packages are."""

import importlib.metadata
import os
import pathlib
from collections.abc import Mapping

from prism_jax.io.errors import InputError

FOLDERS: Mapping[str, str] = {
    "example-robot-data": "robots",
    "rtb-data": "rtbdata/xacro",
}
"""Packages with robots, and the folder that holds them, wherever it lies."""
SUFFIXES = (".urdf", ".xacro")


def robots_folder(package: str) -> pathlib.Path:
    """Where a package keeps its robots; InputError where it is not installed.

    The place is asked of the installed package's own list of files; nothing of it is
    imported.
    """
    remedy = 'install the extra: pip install "prism_jax[robots]"'
    try:
        files = importlib.metadata.files(package) or []
    except importlib.metadata.PackageNotFoundError:
        raise InputError(package, "not installed", remedy) from None
    for file in files:
        before, found, _ = f"/{file.as_posix()}".partition(f"/{FOLDERS[package]}/")
        if file.suffix in SUFFIXES and found:
            above = len(file.parts) - len(pathlib.PurePath(before + found).parts)
            path = pathlib.Path(os.path.abspath(file.locate()))
            if path.parents[above].is_dir():
                return path.parents[above]
    raise InputError(package, "no robots in this package", remedy)
