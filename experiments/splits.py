"""Which split of a data set a training sees, which validates it, and their digests."""

import hashlib
import json
from collections.abc import Mapping

import numpy as np

from prism_jax.data.datasets import DATASETS, folder_of, open_dataset
from prism_jax.data.manifest import read_manifest
from prism_jax.data.source import Example, Source
from prism_jax.io.errors import InputError, StrPath, choose


class Subset:
    """Some items of a source, in the order of `rows`."""

    def __init__(self, source: Source, rows: np.ndarray):
        self._source, self._rows = source, np.asarray(rows)
        self.categories = source.categories
        self.objects = np.unique(source.objects[self._rows], return_inverse=True)[1]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Example:
        return self._source[int(self._rows[index])]


def training_split(name: str) -> str:
    """The split that a training sees; InputError if a set is for tests alone."""
    split = DATASETS[name].training
    if split is None:
        raise InputError(name, "no training split", "train on another set")
    return split


def validation_split(name: str) -> str:
    """The split of its own that a training is validated on; InputError if a set has
    none."""
    split = DATASETS[name].validation
    if split is None:
        having = (other for other, known in DATASETS.items() if known.validation)
        fault = "no validation split"
        raise InputError(name, fault, f"use one of {', '.join(having)}")
    return split


def validation_place(text: str) -> tuple[str, str]:
    """A set and the split of it that validates, from SET or SET/SPLIT; InputError where
    the set has none, or where it is for tests."""
    name, _, split = text.partition("/")
    choose("data set", name, DATASETS)
    known = "validation", "novel"
    return name, choose("split", split, known) if split else validation_split(name)


def validation_rows(
    text: str, data_dir: StrPath | None = None, count: int = 200
) -> Subset:
    """So many examples of a `validation_place`, or all, evenly spaced."""
    validation = open_dataset(*validation_place(text), data_dir)
    rows = np.unique(np.linspace(0, len(validation) - 1, count, dtype=int))
    return Subset(validation, rows)


def held_out(
    name: str, data_dir: StrPath | None = None, num_validation: int = 200
) -> tuple[Subset, Subset]:
    """What to train on, of a set without a validation split, and what to validate with:
    so many objects, evenly spaced and no more than a tenth of all, held out with all
    their views, of which the first is taken."""
    train = open_dataset(name, training_split(name), data_dir)
    objects, first = np.unique(train.objects, return_index=True)
    if len(objects) < 2:
        raise InputError("data", "only one object", "add more to train on")
    count = min(num_validation, max(1, len(objects) // 10))
    held = np.unique(np.linspace(0, len(objects) - 1, count + 2, dtype=int)[1:-1])
    rest = np.flatnonzero(~np.isin(train.objects, held))
    return Subset(train, rest), Subset(train, first[held])


def parts_of(name: str, data_dir: StrPath | None = None) -> list[str]:
    """The sets that a training on this one sees: those packed into it, or itself."""
    if name == "packed" and data_dir is not None:
        manifest = read_manifest(folder_of(name, "train", data_dir), "pack it")
        return sorted(manifest["sources"])
    return [name]


def digest_of(name: str, split: str, data_dir: StrPath | None = None) -> str | None:
    """Twelve digits of a split's files (`content_digest`); None for a set that has no
    manifest."""
    if DATASETS[name].folder is None:
        return None
    return content_digest(folder_of(name, split, data_dir))


def content_digest(folder: StrPath) -> str | None:
    """Twelve digits that tell a folder's files from all others; None where there is no
    finished build."""
    try:
        files = read_manifest(folder, "")["files"]
    except InputError:
        return None
    return files_digest(files)


def files_digest(files: Mapping[str, str]) -> str:
    """Twelve digits that tell files, by name and sha256, from all others."""
    listed = json.dumps(files, sort_keys=True).encode()
    return hashlib.sha256(listed).hexdigest()[:12]
