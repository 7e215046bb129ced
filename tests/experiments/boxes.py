"""A source of two kinds of boxes, and completers that are no networks."""

import numpy as np
import pytest

from prism_jax.data.source import Example


class Boxes:
    """Clouds on boxes, seen from above: `views` in a row show one box.

    Every coordinate is multiplied by `scale` and moved by `shift`.
    """

    categories = ("flat", "tall", "none of these")

    def __init__(self, objects=5, views=1, scale=1.0, shift=(0.0, 0.0, 0.0)):
        self.objects = np.repeat(np.arange(objects), views)
        self.views, self.scale = views, scale
        self.shift = np.array(shift, np.float64)

    def __len__(self):
        return len(self.objects)

    def __getitem__(self, index):
        item, view = divmod(range(len(self))[index], self.views)
        rng = np.random.default_rng(item)
        points = rng.uniform(-1, 1, (200, 3))
        points /= np.abs(points).max(axis=1, keepdims=True)
        points *= [1.0, 0.6, 0.1 + 0.3 * (item % 2)]
        points[0], points[1] = (-1, 0, 0), (1, 0, 0)
        half = points[points[:, 2] > np.quantile(points[:, 2], 0.3 + 0.1 * view)]
        moved = [
            (cloud * self.scale + self.shift).astype(np.float32)
            for cloud in (points, half, np.array([0.0, 0.0, 4.0]))
        ]
        kind = self.categories[item % 2]
        return Example(*moved, kind, f"{item}/{view}")


@pytest.fixture(scope="session")
def boxes() -> type[Boxes]:
    return Boxes
