"""Examples made of random boxes: enough to train on, without a corpus."""

import numpy as np
import pytest

from prism_jax.data.corpus import Examples
from prism_jax.data.examples import quantise


def boxes(count, seed):
    """``count`` examples: surfaces of boxes, and the half that a viewpoint sees."""
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.3, 1.0, (count, 1, 3))
    sizes /= sizes.max(-1, keepdims=True)
    surface = rng.uniform(-1, 1, (count, 4200, 3))
    surface /= np.abs(surface).max(-1, keepdims=True)
    eyes = rng.normal(size=(count, 1, 3))
    eyes *= 3.0 / np.linalg.norm(eyes, axis=-1, keepdims=True)
    seen = surface[:, :2048] * np.sign((surface[:, :2048] * eyes).sum(-1))[..., None]
    return Examples(
        quantise(seen * sizes),
        quantise(surface * sizes),
        eyes[:, 0].astype(np.float32),
        np.arange(count) % 2,
        ("even", "odd"),
    )


@pytest.fixture(scope="session")
def examples():
    return boxes(20, seed=0)


@pytest.fixture(scope="session")
def validation_examples():
    return boxes(10, seed=1)
