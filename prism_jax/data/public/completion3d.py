"""Completion3D: eight categories of ShapeNet at 2,048 points.

Tchapmi et al., "TopNet", CVPR 2019 (https://github.com/lynetcha/completion3d): `root`,
the release's folder `shapenet`, holds train.list, val.list and test.list with one
<synset>/<model> a line, <split>/partial/<synset>/<model>.h5 and, but for the test,
<split>/gt/<synset>/<model>.h5, each with one array `data`.
"""

import os
import pathlib

import numpy as np
from jaxtyping import Float32

from prism_jax.data.public.hdf5 import read_array
from prism_jax.data.public.layout import (
    ListedSource,
    Model,
    read_list,
    require_files,
    sound_cloud,
)
from prism_jax.data.public.synsets import SYNSETS
from prism_jax.data.source import Example
from prism_jax.io.errors import choose

SPLITS = ("train", "val", "test")
NUM_POINTS = 2048


class Completion3D(ListedSource):
    """One partial cloud a model, in the frame of the complete one.

    The test split is the benchmark's: its complete clouds were never published, so that
    `complete` is None, and its models have numbers and no category but "all".
    """

    def __init__(self, root: str | os.PathLike, split: str):
        root = pathlib.Path(root)
        choose("split", split, SPLITS)
        form = "a line such as 02691156/1a04e3eab45ca15dd86060f189eb133"
        groups = read_list(root / f"{split}.list", r"([\w-]+)/([\w-]+)", form)
        models = [Model(SYNSETS.get(key, key), key, model) for key, model in groups]
        super().__init__(root, models, views=1)
        self.split = split
        kinds = ("partial",) if split == "test" else ("partial", "gt")
        wanted: dict[str, list[str]] = {}
        for model in models:
            for kind in kinds:
                folder = f"{split}/{kind}/{model.folder}"
                wanted.setdefault(folder, []).append(f"{model.id}.h5")
        layout = " and ".join(f"{split}/{kind}/<synset>/<model>.h5" for kind in kinds)
        require_files(root, wanted, f"{split}.list", layout)

    def __getitem__(self, index: int) -> Example:
        model, _ = self.locate(index)
        partial = self._read("partial", model)
        complete = None
        if self.split != "test":
            complete = self._read("gt", model, NUM_POINTS)
        name = f"{model.folder}/{model.id}"
        return Example(complete, partial, None, model.category, name)

    def _path(self, kind: str, model: Model) -> pathlib.Path:
        return self.root / self.split / kind / model.folder / f"{model.id}.h5"

    def _read(
        self, kind: str, model: Model, num_points: int | None = None
    ) -> Float32[np.ndarray, "N 3"]:
        path = self._path(kind, model)
        return sound_cloud(read_array(path, "data"), path, num_points)
