"""Every data set by the name that flags use, and what a training holds out of it."""

import os
import pathlib
from typing import Any

import numpy as np

from prism_jax.data.builds import content_digest, read_manifest
from prism_jax.data.corpus import Corpus, CorpusConfig, build_corpus, split_dir
from prism_jax.data.packed import Packed
from prism_jax.data.public import PUBLIC_SETS, open_public
from prism_jax.data.recordings import RecordedCells
from prism_jax.data.source import Example, Source
from prism_jax.io.errors import InputError, choose
from prism_jax.io.files import default_cache_dir
from prism_jax.simulation.roboarm import build as roboarm
from prism_jax.simulation.roboarm.models import arms_of

GENERATED = ("shapes", "roboarm")
"""Built on the machine; their folder is the user's cache folder unless named."""
DATASETS = (*GENERATED, "packed", "recordings", *PUBLIC_SETS)
SCORED = tuple(name for name in DATASETS if name != "packed")
"""What can be scored on: packed examples do not tell which of them show one object."""
UNSPLIT = ("recordings", "meshes")
"""All of these is the one split "all"."""
TEST_ONLY = ("kitti", "shapenet_unseen21", "projected_shapenet_unseen21")
_WITH_VALIDATION = {name: "validation" for name in (*GENERATED, "packed")}
_WITH_VALIDATION |= {"pcn": "val", "completion3d": "val"}
_WITHOUT_TEST = ("kitti", "completion3d", *UNSPLIT)


def build_dataset(
    name: str,
    split: str,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    **changes: Any,
) -> pathlib.Path:
    """Builds what is missing of a generated set's split, and returns its folder.

    `changes` are fields of `CorpusConfig`, or arguments of `build_roboarm`. A name that
    is not `GENERATED` raises InputError.
    """
    if name == "shapes":
        return build_corpus(CorpusConfig(split, **changes), data_dir, num_workers)
    if name == "roboarm":
        folder = _roboarm_dir(split, data_dir)
        return roboarm.build_roboarm(split, folder, num_workers=num_workers, **changes)
    raise InputError(name, "is not generated", f"use one of {', '.join(GENERATED)}")


def build_if_missing(
    name: str,
    split: str,
    data_dir: str | os.PathLike | None = None,
    **changes: Any,
) -> None:
    """Builds a generated set's split, or goes on with what was broken off, unless one
    is finished there, of whatever settings.

    Sets that are not generated are left alone. `changes` as in `build_dataset`.
    """
    if name in GENERATED and digest_of(name, split, data_dir) is None:
        build_dataset(name, split, data_dir, **changes)


def digest_of(
    name: str, split: str, data_dir: str | os.PathLike | None = None
) -> str | None:
    """What tells a split's files from those of any other build (`content_digest`); None
    for a set that has no manifest."""
    folder = _folder(name, split, data_dir)
    return None if folder is None else content_digest(folder)


def training_split(name: str) -> str:
    """The split that a training sees."""
    return "all" if name in UNSPLIT else "train"


def validation_split(name: str) -> str:
    """The split of its own that a training is validated on; InputError if a set has
    none."""
    if name not in _WITH_VALIDATION:
        fault = "has no validation split of its own"
        raise InputError(name, fault, f"use one of {', '.join(_WITH_VALIDATION)}")
    return _WITH_VALIDATION[name]


def opened_splits(name: str) -> tuple[str, ...]:
    """The splits that a training opens: its own, and that it is validated on."""
    own = (training_split(name),)
    return (*own, validation_split(name)) if name in _WITH_VALIDATION else own


def scored_splits(name: str) -> tuple[str, ...]:
    """The splits with ground truth that no training sees, validation first; InputError
    if there is none."""
    validation = _WITH_VALIDATION.get(name)
    splits = () if validation is None else (validation,)
    splits += () if name in _WITHOUT_TEST else ("test",)
    splits += ("unseen",) if name == "shapes" else ()
    if name not in SCORED or not splits:
        fault = "has no split with ground truth that no training sees"
        raise InputError(name, fault, "score on another set")
    return splits


def open_dataset(
    name: str, split: str, data_dir: str | os.PathLike | None = None, **options: Any
) -> Source:
    """A data set's split as a Source.

    `data_dir` holds the set: the folder given to `make_data`, the root of recordings
    or of a public set in its published layout, or what `experiments.pack` filled.
    Recordings have the one split "all".
    Anything that is not there, or not as it should be, raises InputError.
    """
    choose("data set", name, DATASETS)
    if options and name not in PUBLIC_SETS:
        raise InputError(name, f"has no options, not {', '.join(options)}", "give none")
    if name == "shapes":
        return Corpus(split, data_dir)
    if name == "roboarm":
        folder = _roboarm_dir(split, data_dir)
        command = f"python -m experiments.make_data --dataset=roboarm --split={split}"
        where = "" if data_dir is None else f" --output_dir={data_dir}"
        remedy = f"build it: {command}{where}"
        read_manifest(folder, remedy, roboarm.GENERATOR_VERSION)
        return RecordedCells(folder)
    if data_dir is None:
        raise InputError(name, "is not generated", "name its folder with --data_dir")
    if name == "packed":
        return Packed(pathlib.Path(data_dir) / split)
    if name == "recordings":
        choose("split", split, ("all",))
        return RecordedCells(data_dir)
    return open_public(name, data_dir, split, **options)


def open_training(
    name: str, data_dir: str | os.PathLike | None = None, num_validation: int = 200
) -> tuple[Source, Source]:
    """What to train on, and `num_validation` examples to validate with.

    These are a split of their own where the set has one. Else as many objects, evenly
    spaced through the set and no more than a tenth of it, are held out with all their
    views. The test split is not opened.
    """
    if name in TEST_ONLY:
        raise InputError(name, "has no training split", "train on another set")
    train = open_dataset(name, training_split(name), data_dir)
    if name in _WITH_VALIDATION:
        validation = open_dataset(name, _WITH_VALIDATION[name], data_dir)
        rows = np.unique(np.linspace(0, len(validation) - 1, num_validation, dtype=int))
        return train, Subset(validation, rows)
    return hold_out(train, num_validation)


def parts_of(name: str, data_dir: str | os.PathLike | None = None) -> list[str]:
    """The sets that a training on this one sees: those packed into it, or itself."""
    if name == "packed" and data_dir is not None:
        manifest = read_manifest(pathlib.Path(data_dir) / "train", "pack it")
        return sorted(manifest["sources"])
    return [name]


def mesh_licences(name: str) -> str:
    """Whose meshes a set's training split is made of, and how they are licensed."""
    if name == "shapes":
        return "procedural, made by prism_jax (Apache-2.0), nobody else's meshes"
    if name == "roboarm":
        arms = ", ".join(f"{arm.name} {arm.licence}" for arm in arms_of("train"))
        return f"arms of example-robot-data ({arms}), the rest procedural"
    return "as its publisher licenses it"


def hold_out(source: Source, count: int) -> tuple["Subset", "Subset"]:
    """The source without some objects, and the first view of each of those.

    `count` objects, evenly spaced, or a tenth of all if that is fewer. A source of a
    single object raises InputError.
    """
    objects, first = np.unique(source.objects, return_index=True)
    count = min(count, max(1, len(objects) // 10))
    if len(objects) < 2:
        raise InputError("data", "holds a single object", "add more to train on")
    held = np.unique(np.linspace(0, len(objects) - 1, count + 2, dtype=int)[1:-1])
    train = np.flatnonzero(~np.isin(source.objects, held))
    return Subset(source, train), Subset(source, first[held])


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


def _folder(
    name: str, split: str, data_dir: str | os.PathLike | None
) -> pathlib.Path | None:
    """Where a split's manifest is, of a set that has one."""
    if name == "shapes":
        return split_dir(split, data_dir)
    if name == "roboarm":
        return _roboarm_dir(split, data_dir)
    if data_dir is None or name not in ("packed", "recordings"):
        return None
    root = pathlib.Path(data_dir)
    return root / split if name == "packed" else root


def _roboarm_dir(split: str, data_dir: str | os.PathLike | None) -> pathlib.Path:
    root = default_cache_dir() if data_dir is None else pathlib.Path(data_dir)
    return root / f"roboarm-{split}"
