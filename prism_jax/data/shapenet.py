"""ShapeNet-55, ShapeNet-34 and the 21 unseen categories.

PoinTr's release (Yu et al., ICCV 2021; https://github.com/yuxumin/PoinTr): `root`, the
folder ShapeNet55-34, holds shapenet_pc/<synset>-<model>.npy, 8,192 points each, and the
lists <subset>/train.txt and <subset>/test.txt, one such name a line. A set that is not
laid out so is refused before the first item is read.
"""

import json
import os
import pathlib
import re

import numpy as np
from jaxtyping import Float32, Int

from prism_jax.assets import asset
from prism_jax.data.crops import CROP_SHARES, CROP_VIEWPOINTS, crop
from prism_jax.data.source import Example, sound_cloud
from prism_jax.io.arrays import read_npy
from prism_jax.io.errors import InputError, StrPath, choose
from prism_jax.io.files import parsing, read_bytes

SUBSETS = {
    "ShapeNet-55": ("train", "test"),
    "ShapeNet-34": ("train", "test"),
    "ShapeNet-Unseen21": ("test",),
}
"""Published lists and their splits."""

SYNSETS: dict[str, str] = json.loads(asset("shapenet_synsets.json").read_text())
"""Names of ShapeNet's 55 categories by their WordNet synset (Chang et al., 2015)."""

NUM_POINTS = 8192
_LINE = r"\d{8}-[\w-]*\.npy"
"""Two published models, 04379243-.npy and 02747177-.npy, have no id."""
_FORM = "a line such as 02691156-1a04e3eab45ca15dd86060f189eb133.npy"
_LAYOUT = "shapenet_pc/<synset>-<model>.npy beside the folders of lists"
_TAKE_LIST = "use the list published with the data set"
_SHOWN = 3


class ShapeNet:
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
        self.difficulties: tuple[str, ...] = ()
        if difficulty is not None:
            choose("difficulty", difficulty, (*CROP_SHARES, "all"))
            every = difficulty == "all"
            self.difficulties = tuple(CROP_SHARES) if every else (difficulty,)
        self.views = len(self.difficulties) * len(CROP_VIEWPOINTS) or 1
        choose("subset", subset, SUBSETS)
        choose("split", split, SUBSETS[subset])
        self.root = pathlib.Path(root)
        self.files = _listed(self.root / subset / f"{split}.txt")
        self._require_files(f"{subset}/{split}.txt")
        self.categories = tuple(sorted(set(map(_category, self.files))))

    @property
    def objects(self) -> Int[np.ndarray, " N"]:
        """Every model as often as it was seen."""
        return np.repeat(np.arange(len(self.files)), self.views)

    def __len__(self) -> int:
        return len(self.files) * self.views

    def __getitem__(self, index: int) -> Example:
        number, view = divmod(range(len(self))[index], self.views)
        file = self.files[number]
        category, name = _category(file), file.removesuffix(".npy")
        complete = _normalised(self.root / "shapenet_pc" / file)
        if not self.difficulties:
            return Example(complete, None, None, category, name)
        difficulty, view = divmod(view, len(CROP_VIEWPOINTS))
        difficulty = self.difficulties[difficulty]
        partial = crop(complete, CROP_VIEWPOINTS[view], CROP_SHARES[difficulty])
        name = f"{name}/{difficulty}/{view}"
        return Example(complete, partial.astype(np.float32), None, category, name)

    def _require_files(self, listed_in: str) -> None:
        """The folder is listed once, since a network drive answers that far sooner than
        questions for single files."""
        folder = self.root / "shapenet_pc"
        present = set(os.listdir(folder)) if folder.is_dir() else set()
        missing = [f"shapenet_pc/{file}" for file in self.files if file not in present]
        if missing:
            first = ", ".join(missing[:_SHOWN] + ["..."] * (len(missing) > _SHOWN))
            total = len(self.files)
            fault = f"{len(missing)} of the {total} files in {listed_in} are missing"
            remedy = f"copy the whole data set here, as {_LAYOUT}"
            raise InputError(self.root, f"{fault}: {first}", remedy)


def _listed(path: pathlib.Path) -> tuple[str, ...]:
    """The names of a list's clouds, none twice."""
    data = read_bytes(path)
    with parsing(path, "a text file", _TAKE_LIST):
        lines = data.decode().splitlines()
    files = tuple(line.strip() for line in lines if line.strip())
    for file in files:
        if not re.fullmatch(_LINE, file):
            fault = f"invalid line {file[:80]!r}, expected {_FORM}"
            raise InputError(path, fault, _TAKE_LIST)
    if not files:
        raise InputError(path, "no objects listed", _TAKE_LIST)
    if len(set(files)) < len(files):
        raise InputError(path, "duplicate object", _TAKE_LIST)
    return files


def _category(file: str) -> str:
    synset = file.partition("-")[0]
    return SYNSETS.get(synset, synset)


def _normalised(path: pathlib.Path) -> Float32[np.ndarray, "8192 3"]:
    """Centroid at the origin, farthest point at distance one."""
    points = sound_cloud(read_npy(path), path, NUM_POINTS).astype(np.float64)
    points -= points.mean(axis=0)
    return (points / np.linalg.norm(points, axis=1).max()).astype(np.float32)
