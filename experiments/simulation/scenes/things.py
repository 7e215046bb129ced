"""What stands in scenes: meshes of the sets of single objects, by split."""

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import trimesh

from experiments.simulation.objects.catalogues import FOLDER, Model
from experiments.simulation.objects.categories import category_of
from experiments.simulation.objects.survey import survey
from experiments.simulation.open_shapes import CATEGORY, make_open_shape
from experiments.simulation.open_shapes.build import OpenConfig
from experiments.simulation.shapes import make_shape
from experiments.simulation.shapes.build import ShapesConfig, shape_seed
from prism_jax.io.errors import InputError, choose

SOURCES: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "shapes": {
        "train": ("train",),
        "validation": ("validation", "novel"),
        "test": ("test", "unseen"),
    },
    "open": {"train": ("train",)},
    "objects": {"train": ("train",), "validation": ("validation",), "test": ("test",)},
}
"""Splits of each source, by the split of the scenes that they stand in."""

DEFAULT_SOURCES = ("shapes", "open")
"""Those that are procedural, which every machine has."""


class Thing(NamedTuple):
    """A mesh, z up, and what it is; `two_sided` as in `raycast.sample_outside`."""

    mesh: trimesh.Trimesh
    category: str
    two_sided: bool = False


Pool = Callable[[np.random.Generator], Thing]
"""Draws a thing. Can be pickled."""


class Pools(NamedTuple):
    """What the things of a split's scenes are drawn from, each as often as others."""

    pools: tuple[Pool, ...]  # one for each split of each source
    categories: tuple[str, ...]
    digests: dict[str, str]  # of the meshes of models that people made, by identity

    def draw(self, rng: np.random.Generator) -> Thing:
        """A thing of any of them."""
        return self.pools[rng.integers(len(self.pools))](rng)


def check_sources(sources: Sequence[str], split: str) -> None:
    """Raises InputError for a source that there is not, or where none has the split."""
    for source in sources:
        choose("sources", source, SOURCES)
    if not any(split in SOURCES[source] for source in sources):
        fault = f"{', '.join(sources) or 'none'} cannot stand in scenes of {split}"
        raise InputError("sources", fault, "name shapes or objects too")


def pools_of(
    split: str,
    sources: Sequence[str] = DEFAULT_SOURCES,
    catalogue_dir: str | os.PathLike = FOLDER,
    progress: bool = True,
) -> Pools:
    """What can stand in scenes of a split: the very shapes and models that the sets of
    that name and split have, with the seed 0."""
    check_sources(sources, split)
    pools: list[Pool] = []
    categories, digests = set(), {}
    if "shapes" in sources:
        for name in SOURCES["shapes"][split]:
            config = ShapesConfig(name)
            pools.append(functools.partial(_shape, config))
            categories |= {*config.categories}
    if "open" in sources and split in SOURCES["open"]:
        pools.append(functools.partial(_open_shape, OpenConfig().num_shapes))
        categories.add(CATEGORY)
    if "objects" in sources:
        found = survey([split], catalogue_dir, progress).models
        digests = {model.identity: digest for model, digest in found}
        models = [model for model, _ in found]
        pools.append(functools.partial(_model, models))
        categories |= {category_of(model.title) for model in models}
    return Pools(tuple(pools), tuple(sorted(categories)), digests)


def _shape(config: ShapesConfig, rng: np.random.Generator) -> Thing:
    index = int(rng.integers(config.num_shapes))
    category = config.categories[index % len(config.categories)]
    return Thing(make_shape(category, shape_seed(config, index)), category)


def _open_shape(count: int, rng: np.random.Generator) -> Thing:
    return Thing(make_open_shape(int(rng.integers(count))), CATEGORY)


def _model(models: Sequence[Model], rng: np.random.Generator) -> Thing:
    model = models[rng.integers(len(models))]
    return Thing(model.load(), category_of(model.title), two_sided=True)
