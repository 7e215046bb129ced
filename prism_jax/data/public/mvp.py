"""MVP: sixteen categories of ShapeNet, each model seen from 26 sides.

Pan et al., "Variational Relational Point Completion Network", CVPR 2021. Two releases
are read. Of VRCNet's (https://github.com/paul007pl/VRCNet), mvp_<split>_input.h5 with
the partial clouds and mvp_<split>_gt_<points>pts.h5 with the complete ones, both with
the arrays of eight categories and, by the prefix `novel_`, of eight more. Of the
challenge's (https://github.com/paul007pl/MVP_Benchmark), MVP_Train_CP.h5 and
MVP_Test_CP.h5 with everything, at 2,048 points.
"""

import os
import pathlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Int, Int8

from prism_jax.data.public.hdf5 import find_array, opened
from prism_jax.data.public.layout import require_files, sound_cloud
from prism_jax.data.source import Example
from prism_jax.io.errors import InputError, choose

CATEGORIES = (
    "airplane",
    "cabinet",
    "car",
    "chair",
    "lamp",
    "sofa",
    "table",
    "watercraft",
    "bed",
    "bench",
    "bookshelf",
    "bus",
    "guitar",
    "motorbike",
    "pistol",
    "skateboard",
)
"""In the order of the published labels."""

SPLITS = ("train", "test")
RESOLUTIONS = (2048, 4096, 8192, 16384)
VIEWS = 26


class _Part(NamedTuple):
    """Arrays that belong together: partial clouds, 26 for each complete one."""

    partials: pathlib.Path
    completes: pathlib.Path
    prefix: str
    labels: Int8[np.ndarray, " P"]


class MVP:
    """26 partial clouds of each model, at 2,048 points, and its complete cloud.

    `num_points`, one of `RESOLUTIONS`, is the complete cloud's. Item i is view `i % 26`
    of model `i // 26`, the models of the second eight categories after the others, as
    VRCNet takes them. The cameras are not published. A process opens each file once.
    """

    categories = CATEGORIES

    def __init__(self, root: str | os.PathLike, split: str, num_points: int = 2048):
        root = pathlib.Path(root)
        choose("split", split, SPLITS)
        choose("num_points", str(num_points), map(str, RESOLUTIONS))
        self.num_points = num_points
        both = f"MVP_{split.title()}_CP.h5"
        names = f"mvp_{split}_input.h5", f"mvp_{split}_gt_{num_points}pts.h5"
        prefixes = "", "novel_"
        if num_points == 2048 and (root / both).exists():
            names, prefixes = (both, both), ("",)
        layout = " and ".join(names) + (f", or {both}" if num_points == 2048 else "")
        require_files(root, {"": names}, f"the split {split!r}", layout)
        self._parts = [self._part(root, names, prefix) for prefix in prefixes]

    @property
    def objects(self) -> Int[np.ndarray, " N"]:
        """Every model as often as it was seen."""
        return np.arange(len(self)) // VIEWS

    def __len__(self) -> int:
        return sum(len(part.labels) for part in self._parts)

    def __getitem__(self, index: int) -> Example:
        row = range(len(self))[index]
        for part in self._parts:
            if row < len(part.labels):
                return self._example(part, row)
            row -= len(part.labels)
        raise AssertionError("the parts' lengths add up to the length")

    def _example(self, part: _Part, row: int) -> Example:
        number, view = divmod(row, VIEWS)
        with opened(part.partials, keep=True) as file:
            partial = find_array(file, f"{part.prefix}incomplete_pcds")[row]
        with opened(part.completes, keep=True) as file:
            complete = find_array(file, f"{part.prefix}complete_pcds")[number]
        name = f"{part.prefix}{number:04d}/{view:02d}"
        return Example(
            sound_cloud(complete, f"{part.completes} ({name})", self.num_points),
            sound_cloud(partial, f"{part.partials} ({name})"),
            None,
            CATEGORIES[part.labels[row]],
            name,
        )

    def _part(self, root: pathlib.Path, names: tuple[str, str], prefix: str) -> _Part:
        """Checks that the arrays of a part fit each other, and reads the labels."""
        partials, completes = (root / name for name in names)
        with opened(partials) as file:
            shape = find_array(file, f"{prefix}incomplete_pcds").shape
            labels = np.asarray(find_array(file, f"{prefix}labels")[()])
        with opened(completes) as file:
            truth = find_array(file, f"{prefix}complete_pcds").shape
        models, rest = divmod(labels.size, VIEWS)
        is_input = labels.shape == shape[:1] and shape[2:] == (3,) and rest == 0
        if not is_input or truth != (models, self.num_points, 3):
            raise InputError(
                partials,
                f"{prefix}incomplete_pcds {shape}, {prefix}labels {labels.shape} and "
                f"{prefix}complete_pcds {truth} do not fit 26 views a model of "
                f"{self.num_points} points",
                "copy the set's files again",
            )
        if not np.isin(labels, np.arange(len(CATEGORIES))).all():
            fault = f"has {prefix}labels outside 0 to {len(CATEGORIES) - 1}"
            raise InputError(partials, fault, "copy this file again from the set")
        return _Part(partials, completes, prefix, labels.astype(np.int8))
