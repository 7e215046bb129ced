"""The official network, with its weights and arrays."""

import dataclasses
import functools
from collections import ChainMap
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from experiments.baselines.crapcn import convert_state_dict
from prism_jax.models.backbone import decode, encode_points, partial_indices
from prism_jax.models.config import PCN, SHAPENET55, BackboneConfig

CONFIGS = {"pcn": PCN, "sn55": SHAPENET55}
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

    def check_end_to_end(self, stages) -> None:
        """Of the last stage a few points may move: one neighbour that rounding changed
        moves those that see it."""
        assert tuple(s.shape[1] for s in stages) == self.config.stage_sizes
        for precision in ("f32", "f64"):
            deviations = [
                np.abs(stage - self.arrays[f"official_{precision}/out_{i}"])
                for i, stage in enumerate(stages)
            ]
            *earlier, last = deviations
            assert all(deviation.max() <= 1e-5 for deviation in earlier)
            assert (last < 1e-5).mean() >= 0.99
            assert last.max() < 5e-3

    def state_dict(self) -> dict[str, np.ndarray]:
        names = [name for name in self.arrays if name.startswith("sd/")]
        return {name.removeprefix("sd/"): self.arrays[name] for name in names}


@pytest.fixture(scope="session")
def published(reference):
    """``published(variant)`` for "pcn" or "sn55"."""

    @functools.cache
    def load(variant: str) -> Published:
        # The variants differ in their last layers alone.
        names = dict.fromkeys((f"crapcn_{variant}.npz", "crapcn_pcn.npz", "ops.npz"))
        arrays = ChainMap(*(dict(reference(name)) for name in names))
        config = CONFIGS[variant]
        if len(arrays["input"][0]) != config.num_points:
            config = dataclasses.replace(config, **QUARTER)
        bare = Published(config, arrays, {})
        variables = convert_state_dict(bare.state_dict(), config)
        return bare._replace(variables=variables)

    return load


@pytest.fixture(scope="session")
def run_backbone():
    """``(config, variables, partial) -> stages``, compiled."""

    def run(config, variables, partial):
        indices = partial_indices(partial, config)
        encoded = encode_points(variables, config, partial, indices)
        return decode(variables, config, partial, encoded).stages

    return jax.jit(run, static_argnums=0)
