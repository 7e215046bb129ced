"""The official network, with its weights and arrays."""

import dataclasses
import functools
from collections import ChainMap
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pytest

from experiments.baselines.crapcn import PUBLISHED, convert_state_dict
from prism_jax.models.config import BackboneConfig
from tests.trees import row

QUARTER = dict(
    num_points=512,
    patch_points=(128, 32),
    patch_features=((16, 32), (32, 64)),
    global_features=(128, 128),
    features=32,
    attention_features=16,
    num_initial=128,
)


class Published(NamedTuple):
    """One variant: its config, the file of arrays, and the converted weights."""

    config: BackboneConfig
    arrays: Mapping[str, np.ndarray]
    state_dict: dict[str, np.ndarray]
    variables: dict[str, Any]

    def ref(self, name: str) -> np.ndarray:
        """A stage's reference, channels last."""
        return self.arrays[f"ref/{name}"].swapaxes(1, 2)

    def subtree(self, *path: str) -> dict[str, Any]:
        """The variables of one submodule."""
        out = {}
        for kind, tree in self.variables.items():
            for name in path:
                tree = tree.get(name, {})
            out[kind] = tree
        return out


@pytest.fixture(scope="session")
def frame(tiny_frames):
    """A cloud and its camera."""
    return row(tiny_frames, 0)


@pytest.fixture(scope="session")
def published(reference):
    """``published(variant)`` for "pcn" or "sn55"."""

    @functools.cache
    def load(variant: str) -> Published:
        # The variants differ in their last layers alone.
        names = dict.fromkeys((f"crapcn_{variant}.npz", "crapcn_pcn.npz"))
        arrays = ChainMap(*(dict(reference(name)) for name in names))
        config = PUBLISHED[variant]
        if len(arrays["input"][0]) != config.num_points:
            config = dataclasses.replace(config, **QUARTER)
        names = [name for name in arrays if name.startswith("sd/")]
        state_dict = {name.removeprefix("sd/"): arrays[name] for name in names}
        variables = convert_state_dict(state_dict, config)
        return Published(config, arrays, state_dict, variables)

    return load
