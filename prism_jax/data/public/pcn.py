"""PCN's eight categories of ShapeNet, seen by simulated depth cameras.

Yuan et al., "PCN: Point Completion Network", 3DV 2018, in the layout of GRNet's release
(https://github.com/hzxie/GRNet), which PoinTr took over: `root` holds PCN.json,
<split>/complete/<synset>/<model>.pcd of 16,384 points, and
<split>/partial/<synset>/<model>/<00 to 07>.pcd, in validation and test 00.pcd alone.
"""

import pathlib

from prism_jax.data.public.layout import (
    ListedSource,
    Model,
    read_cloud,
    read_json_list,
    require_files,
)
from prism_jax.data.source import Example
from prism_jax.io.errors import StrPath, choose

SPLITS = ("train", "val", "test")
NUM_POINTS = 16384
TRAIN_VIEWS = 8


class PCN(ListedSource):
    """Eight partial clouds a model in training, one in validation and test. Both clouds
    are in the model's own frame, as ShapeNet has it; the cameras are not published. The
    list of models is `root`/`list_file`."""

    def __init__(self, root: StrPath, split: str, list_file: str = "PCN.json"):
        root = pathlib.Path(root)
        choose("split", split, SPLITS)
        models = read_json_list(root / list_file, split)
        super().__init__(root, models, TRAIN_VIEWS if split == "train" else 1)
        self.split = split
        wanted: dict[str, list[str]] = {}
        for model in models:
            folder = f"{split}/complete/{model.folder}"
            wanted.setdefault(folder, []).append(f"{model.id}.pcd")
        views = [f"{view:02d}.pcd" for view in range(self.views)]
        wanted |= {self._partials(model): views for model in models}
        layout = (
            f"{split}/complete/<synset>/<model>.pcd and "
            f"{split}/partial/<synset>/<model>/{views[0]} to {views[-1]}"
        )
        require_files(root, wanted, list_file, layout)

    def __getitem__(self, index: int) -> Example:
        model, view = self.locate(index)
        path = self.root / self.split / "complete" / model.folder / f"{model.id}.pcd"
        complete = read_cloud(path, NUM_POINTS)
        partial = read_cloud(self.root / self._partials(model) / f"{view:02d}.pcd")
        name = f"{model.folder}/{model.id}/{view:02d}"
        return Example(complete, partial, None, model.category, name)

    def _partials(self, model: Model) -> str:
        return f"{self.split}/partial/{model.folder}/{model.id}"
