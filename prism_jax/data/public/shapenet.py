"""ShapeNet-55, ShapeNet-34 and the 21 unseen categories.

PoinTr's release (Yu et al., ICCV 2021; https://github.com/yuxumin/PoinTr): `root`, the
folder ShapeNet55-34, holds shapenet_pc/<synset>-<model>.npy, 8,192 points each, and the
lists <subset>/train.txt and <subset>/test.txt, one such name a line.
"""

import json
import pathlib

import numpy as np
from jaxtyping import Float32

from prism_jax.assets import asset
from prism_jax.data.crops import CROP_SHARES, CROP_VIEWPOINTS, crop
from prism_jax.data.public.layout import (
    ListedSource,
    Model,
    read_cloud,
    read_list,
    require_files,
)
from prism_jax.data.source import Example
from prism_jax.io.errors import InputError, StrPath, choose

SUBSETS = {
    "ShapeNet-55": ("train", "test"),
    "ShapeNet-34": ("train", "test"),
    "ShapeNet-Unseen21": ("test",),
}
"""Published lists and their splits."""

SYNSETS: dict[str, str] = json.loads(asset("shapenet_synsets.json").read_text())
"""Names of ShapeNet's 55 categories by their WordNet synset (Chang et al., 2015)."""

NUM_POINTS = 8192
_LINE = r"(\d{8})-([\w-]*)\.npy"
"""Two published models, 04379243-.npy and 02747177-.npy, have no id."""
_FORM = "a line such as 02691156-1a04e3eab45ca15dd86060f189eb133.npy"


class ShapeNet(ListedSource):
    """Complete clouds, cropped from eight fixed viewpoints for the published test.

    As in PoinTr's loader, each complete cloud's centroid goes to the origin and its
    farthest point to distance one. Without `difficulty` there is one item a model, and
    whoever trains crops it. With it there are eight, one a viewpoint: the share of the
    points nearest to (+-1, +-1, +-1) is taken away, and what is left is not normalised
    again. The difficulty "all" has the three one after the other for each model.
    """

    def __init__(
        self, subset: str, root: StrPath, split: str, difficulty: str | None = None
    ):
        root = pathlib.Path(root)
        self.difficulties: tuple[str, ...] = ()
        if difficulty is not None:
            choose("difficulty", difficulty, (*CROP_SHARES, "all"))
            every = difficulty == "all"
            self.difficulties = tuple(CROP_SHARES) if every else (difficulty,)
        models = _read_models(root, split, subset)
        views = len(self.difficulties) * len(CROP_VIEWPOINTS) or 1
        super().__init__(root, models, views)

    def __getitem__(self, index: int) -> Example:
        model, view = self.locate(index)
        name = f"{model.folder}-{model.id}"
        complete = _normalised(_complete_path(self.root, model))
        if not self.difficulties:
            return Example(complete, None, None, model.category, name)
        difficulty, view = divmod(view, len(CROP_VIEWPOINTS))
        difficulty = self.difficulties[difficulty]
        partial = crop(complete, CROP_VIEWPOINTS[view], CROP_SHARES[difficulty])
        name = f"{name}/{difficulty}/{view}"
        return Example(complete, partial.astype(np.float32), None, model.category, name)


def _read_models(root: pathlib.Path, split: str, subset: str) -> list[Model]:
    """The models of a split's list, all of whose complete clouds are there."""
    choose("subset", subset, SUBSETS)
    choose("split", split, SUBSETS[subset])
    path = root / subset / f"{split}.txt"
    groups = read_list(path, _LINE, _FORM)
    models = [Model(SYNSETS.get(key, key), key, model) for key, model in groups]
    names = [_complete_path(root, model).name for model in models]
    require_files(
        root,
        {"shapenet_pc": names},
        f"{subset}/{split}.txt",
        "shapenet_pc/<synset>-<model>.npy beside the folders of lists",
    )
    return models


def _complete_path(root: pathlib.Path, model: Model) -> pathlib.Path:
    return root / "shapenet_pc" / f"{model.folder}-{model.id}.npy"


def _normalised(path: pathlib.Path) -> Float32[np.ndarray, "8192 3"]:
    """Centroid at the origin, farthest point at distance one."""
    points = read_cloud(path, NUM_POINTS).astype(np.float64)
    points -= points.mean(axis=0)
    radius = np.linalg.norm(points, axis=1).max()
    if radius == 0:
        fault = "zero extent: all points coincide"
        raise InputError(path, fault, "copy this file again from the data set")
    return (points / radius).astype(np.float32)
