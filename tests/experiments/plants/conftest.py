"""Frames of boxes, some of whose truth is not a number."""

import numpy as np
import pytest

from prism_jax.data.source import Example

EYE = np.array([3.0, -4.0, 2.5], np.float32)


def half_box(seed, count=400):
    """The sides of a box that `EYE` sees."""
    rng = np.random.default_rng(seed)
    shell = rng.uniform(-1, 1, (4 * count, 3))
    shell /= np.abs(shell).max(axis=1, keepdims=True)
    facing = (np.round(shell, 6) * (np.abs(shell) > 0.999)) @ EYE > 0
    size = rng.uniform(0.4, 0.8, 3)
    return (shell[facing][:count] * size).astype(np.float32)


class Boxes:
    """Six sequences of two frames of two robots, with any truth."""

    categories = ("a", "b")
    objects = np.repeat(np.arange(6), 2)

    def __init__(self, truth=np.nan):
        self._truth = truth

    def __len__(self):
        return len(self.objects)

    def __getitem__(self, index):
        if index >= len(self):
            raise IndexError
        number = int(self.objects[index])
        complete = np.full((300, 3), self._truth, np.float32)
        name = self.categories[number % 2]
        return Example(complete, half_box(index), EYE, name, f"{number}/{index}")


@pytest.fixture(scope="session")
def boxes():
    return Boxes
