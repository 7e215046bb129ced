"""The manifest of a folder of data: what it is made from, and every file's sha256."""

import hashlib
import os
import pathlib
from collections.abc import Mapping
from typing import Any

from prism_jax.io.errors import InputError, StrPath
from prism_jax.io.files import read_json

MANIFEST = "manifest.json"


def read_manifest(folder: StrPath, remedy: str, **expected: Any) -> dict[str, Any]:
    """The manifest of a folder that was built to its end. Where there is none, or where
    it does not have these entries, which say what version of prism_jax the reader
    understands, InputError with the remedy."""
    path = pathlib.Path(folder) / MANIFEST
    anew = f"delete it, then {remedy}"
    if not os.path.exists(path):
        raise InputError(folder, "not built yet", remedy)
    manifest = read_json(path, anew)
    if any(manifest.get(name) != value for name, value in expected.items()):
        raise InputError(folder, "built by another version of prism_jax", anew)
    if not isinstance(manifest.get("files"), dict):
        raise InputError(folder, "incomplete: the build was interrupted", remedy)
    return manifest


def hash_files(folder: pathlib.Path) -> dict[str, str]:
    """The sha256 of every file below a folder, by relative path; hidden files, files in
    hidden folders, and the manifest itself do not count."""
    hashes = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in name.parts)
        if not hidden and name.as_posix() != MANIFEST:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256")
            hashes[name.as_posix()] = digest.hexdigest()
    return hashes


def check_files(folder: pathlib.Path, files: Mapping[str, str], remedy: str) -> None:
    """Raises InputError unless a folder holds its manifest's files, and no others."""
    found = hash_files(folder)
    for name in sorted(files.keys() | found.keys()):
        if name not in found:
            raise InputError(folder / name, "missing but in the manifest", remedy)
        if name not in files:
            raise InputError(folder / name, "not in the manifest", "move it elsewhere")
        if files[name] != found[name]:
            fault = "differs from the manifest's sha256"
            raise InputError(folder / name, fault, remedy)
