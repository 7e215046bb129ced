"""The data set `open`: every shape a kind of its own."""

import dataclasses
from collections.abc import Iterator
from typing import ClassVar

from experiments.simulation.open_shapes import CATEGORY, make_open_shape
from experiments.simulation.shapes import category_rng
from experiments.simulation.shapes.build import ShapesConfig
from experiments.simulation.views import examples, views_of
from prism_jax.data.datasets import OPEN_VERSION
from prism_jax.data.source import Example


@dataclasses.dataclass(frozen=True)
class OpenConfig(ShapesConfig):
    """What the one split is made of, for `build_shapes`."""

    SIZES: ClassVar = {"train": {"num_shapes": 12_000, "num_views": 8}}
    SET: ClassVar = ("open", "open shapes", OPEN_VERSION)

    split: str = "train"

    @property
    def categories(self) -> tuple[str, ...]:
        """The one that there is."""
        return (CATEGORY,)

    def examples(self, index: int) -> Iterator[Example]:
        """The views of a shape."""
        seed = (self.seed << 32) + index
        mesh, rng = make_open_shape(seed), category_rng(CATEGORY, seed, 1)
        views = views_of(mesh, rng, self.num_views, self.partial)
        return examples(views, CATEGORY, f"{index:06d}")
