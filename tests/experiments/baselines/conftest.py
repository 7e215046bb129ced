"""The networks to compare with, tiny, each compiled once."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.baselines.fsc import FSC, FSCConfig
from experiments.baselines.pcn import PCN, PCNConfig
from experiments.baselines.pointr import PoinTr, PoinTrConfig
from experiments.baselines.seedformer import SeedFormer, SeedFormerConfig
from tests.trees import drawn

TINY = {
    "pcn": PCN(
        PCNConfig(
            num_points=24,
            local_features=(8, 16),
            global_features=(16, 32),
            coarse_features=(32, 32),
            num_coarse=8,
            fold_features=(16, 16),
            grid_size=2,
        )
    ),
    "fsc": FSC(
        FSCConfig(
            num_points=24,
            local_features=(4, 8, 8),
            global_features=(8, 16, 16),
            coarse_features=(16, 16),
            num_coarse=8,
            near_features=(8, 8),
            num_neighbors=3,
            radius=0.45,
            fold_features=(16, 16),
            grid_size=2,
            use_norm=False,
        )
    ),
    "pointr": PoinTr(
        PoinTrConfig(
            num_points=64,
            num_centers=(32, 16),
            center_features=(4, 8, 8, 8, 8),
            center_neighbors=4,
            norm_groups=2,
            features=16,
            num_heads=2,
            depth=(1, 1),
            block_neighbors=4,
            position_features=8,
            global_features=16,
            num_queries=8,
            fold_side=2,
            fold_features=(16, 8),
            use_norm=False,
        )
    ),
    "seedformer": SeedFormer(
        SeedFormerConfig(
            num_points=40,
            patch_points=(16, 8),
            patch_features=((6, 8), (8, 12)),
            global_features=(8, 8),
            patch_neighbors=4,
            num_neighbors=3,
            features=8,
            attention_features=4,
            attention_ratio=2,
            num_initial=20,
            up_factors=(1, 2),
            use_norm=False,
        )
    ),
}


class Tiny(NamedTuple):
    network: Any
    variables: dict
    partial: jax.Array  # three clouds
    apply: Callable  # compiled


@pytest.fixture(scope="session")
def tiny_network(quick_jit) -> Callable[[str], Tiny]:
    """By name."""

    @functools.cache
    def made(name: str) -> Tiny:
        network = TINY[name]
        rng = np.random.default_rng(0)
        points = rng.uniform(-1, 1, (3, network.config.num_points, 3))
        partial = jnp.asarray(points, jnp.float32)
        return Tiny(network, drawn(network, partial), partial, quick_jit(network.apply))

    return made
