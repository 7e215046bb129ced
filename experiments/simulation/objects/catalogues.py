"""Catalogues of models: Sweet Home 3D's (`.sh3f`), zip archives of OBJ models, y up.

`PluginFurnitureCatalog.properties` describes them, model by model: `name#7=Bath`.
Sweet Home 3D turns a model by its `modelRotation` and then stretches it to the given
width (x), height (y) and depth (z); its front is along +z. The Debian package
`sweethome3d-furniture` brings them; no file of theirs is part of prism_jax.
"""

import dataclasses
import functools
import os
import pathlib
import re
import tomllib
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import trimesh

from experiments.simulation.packing import parse_mesh
from prism_jax.io.errors import InputError


@dataclasses.dataclass(frozen=True)
class Model:
    """A mesh that somebody made, with whom to thank for it."""

    catalogue: str
    name: str  # tells it from the catalogue's others
    title: str  # what it shows, in English
    creator: str
    licence: str
    # Its mesh, z up, front along +y, in any unit; InputError where it cannot be read.
    load: Callable[[], trimesh.Trimesh]
    fault: str | None = None  # why it is no object, if its catalogue says so

    @property
    def identity(self) -> str:
        """Tells it from all other models."""
        return f"{self.catalogue}/{self.name}"


_TEXT = pathlib.Path(__file__).with_name("categories.toml").read_text()
_WORDS = {name: words.split() for name, words in tomllib.loads(_TEXT).items()}
NO_OBJECTS = {
    "wall_plate": "is a wall plate",
    "opening": "belongs to a door or a window",
}
"""What is left out, and how it is told."""
OTHER = "other"
CATEGORIES = (*(name for name in _WORDS if name not in NO_OBJECTS), OTHER)


def category_of(title: str) -> str:
    """One of `CATEGORIES` or of `NO_OBJECTS` by a model's English title: that of the
    longest known word or phrase in it, of two as long the first; else `OTHER`."""
    told = f"-{re.sub('[^a-z0-9]+', '-', title.lower())}-"
    found = [
        (len(word), category)
        for category, words in _WORDS.items()
        for word in words
        if f"-{word}-" in told
    ]
    return max(found, key=lambda pair: pair[0])[1] if found else OTHER


PROPERTIES = "PluginFurnitureCatalog.properties"
MAX_PROPERTIES_BYTES = 2**22
MAX_MODEL_BYTES = 2**26
REMEDY = "put the catalogue in place again"
Z_UP = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
"""From x, y up, front along z to z up, front along y."""


def read_catalogue(path: str | os.PathLike, licence: str) -> tuple[str, list[Model]]:
    """A catalogue's version, and its models in the order of its own numbers.

    What is missing, damaged, or no such catalogue raises InputError; so does a model
    whose mesh cannot be read, when it is loaded.
    """
    path = pathlib.Path(path)
    data = read_member(path, PROPERTIES, MAX_PROPERTIES_BYTES)
    own, entries = _properties(data.decode("latin-1"))
    try:
        models = [_model(path, licence, entries[number]) for number in sorted(entries)]
        return own["version"], models
    except (KeyError, ValueError) as error:
        fault = f"not a catalogue of models ({error})"
        raise InputError(path, fault, REMEDY) from None


def read_member(path: str | os.PathLike, name: str, max_bytes: int) -> bytes:
    """All bytes of one member of a zip archive; nothing is unpacked to disk.

    No more is decompressed than the archive claims, and it may claim no more than
    `max_bytes`. An archive or a member that is missing, damaged, too large, encrypted
    or empty raises InputError.
    """
    subject = f"{os.fspath(path)}: {name}"
    try:
        with zipfile.ZipFile(path) as archive:
            member = archive.getinfo(name)
            if not 0 < member.file_size <= max_bytes:
                size = f"{member.file_size:,} bytes"
                fault = f"size {size} is not within 1 to {max_bytes:,}"
                raise InputError(subject, fault, REMEDY)
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(subject, "compression is not supported", REMEDY)
            return archive.read(member)
    except FileNotFoundError:
        raise InputError(path, "no such file", "check the path") from None
    except KeyError:
        raise InputError(subject, "not in the archive", REMEDY) from None
    except (OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(subject, f"cannot be read ({error})", REMEDY) from None


def _properties(text: str) -> tuple[dict[str, str], dict[int, dict[str, str]]]:
    """What is said of the catalogue, and of each model by its number."""
    own: dict[str, str] = {}
    entries: dict[int, dict[str, str]] = defaultdict(dict)
    for line in text.splitlines():
        key, equals, value = line.partition("=")
        if not equals or line.startswith("#"):
            continue
        value = re.sub(r"\\u([0-9a-fA-F]{4})", lambda m: chr(int(m[1], 16)), value)
        name, numbered, number = key.strip().partition("#")
        if not numbered:
            own[name] = value.strip()
        elif number.isdecimal():
            entries[int(number)][name] = value.strip()
    return own, entries


def _model(path: pathlib.Path, licence: str, entry: Mapping[str, str]) -> Model:
    member = entry["model"].lstrip("/")
    size = tuple(float(entry[name]) for name in ("width", "height", "depth"))
    turn = tuple(float(number) for number in entry.get("modelRotation", "").split())
    sound = all(0 < side < np.inf for side in size) and np.isfinite(turn).all()
    if len(turn) not in (0, 9) or not sound:
        raise ValueError(f"{member}: rotation {turn}, size {size}")
    return Model(
        path.stem,
        pathlib.PurePosixPath(member).stem,
        entry["name"],
        entry["creator"],
        licence,
        functools.partial(_load, path, member, turn, size),
        NO_OBJECTS["opening"] if entry.get("doorOrWindow") == "true" else None,
    )


def _load(
    path: pathlib.Path, member: str, turn: tuple[float, ...], size: tuple[float, ...]
) -> trimesh.Trimesh:
    mesh = parse_mesh(
        read_member(path, member, MAX_MODEL_BYTES),
        pathlib.PurePosixPath(member).suffix[1:].lower(),
        f"{path}: {member}",
    )
    rotation = np.reshape(turn, (3, 3)) if turn else np.eye(3)
    vertices = np.asarray(mesh.vertices) @ rotation.T
    extents = np.ptp(vertices, axis=0)
    stretched = vertices * (size / np.where(extents > 0, extents, 1.0))
    return trimesh.Trimesh(stretched @ Z_UP.T, mesh.faces, process=False)


PACKAGE = "sweethome3d-furniture"
FOLDER = pathlib.Path("/usr/share/sweethome3d/furniture")  # Debian's place


class Catalogue(NamedTuple):
    """A file of models by one maker, or from one place."""

    name: str  # of the file, without `.sh3f`
    split: str  # what all its models belong to
    licence: str  # as the package's copyright file and its own give it


CATALOGUES = (
    Catalogue("Scopia", "test", "CC BY 3.0"),
    Catalogue("KatorLegaz", "validation", "CC BY 3.0 US"),
    Catalogue("Reallusion", "validation", "CC BY 3.0 US"),
    Catalogue("BlendSwap-CC-0", "train", "CC0 1.0"),
    Catalogue("BlendSwap-CC-BY", "train", "CC BY 3.0"),
)
"""Splits were fixed before anything was trained on them. A model that two catalogues
have counts as the first one's, so that training never sees what is tested."""


def read_installed(
    catalogue: Catalogue, folder: str | os.PathLike = FOLDER
) -> tuple[str, list[Model]]:
    """A catalogue's version and models; InputError where it is not installed."""
    path = pathlib.Path(folder) / f"{catalogue.name}.sh3f"
    if not path.is_file():
        remedy = f"install {PACKAGE}: apt-get install {PACKAGE}"
        raise InputError(path, "no such catalogue of models", remedy)
    return read_catalogue(path, catalogue.licence)
