"""Weights of the networks to compare with, on disk."""

import pathlib
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.baselines.networks import NETWORKS
from experiments.weights import located
from prism_jax.completion.weights import checked_arrays, read_file, write_file
from prism_jax.io.errors import InputError
from prism_jax.models.variables import Variables


def with_weights() -> list[str]:
    """Those of `NETWORKS` whose weights lie here, by name."""
    return sorted(name for name in NETWORKS if pathlib.Path(located(name)).is_file())


def save_network(
    path: str | pathlib.Path,
    name: str,
    size: str,
    variables: Variables,
    metadata: dict[str, Any],
) -> None:
    """As `prism_jax.completion.weights.save_weights`, of one of `NETWORKS`."""
    write_file(path, variables, {"network": name, "size": size, **metadata})


def load_network(name_or_path: str) -> tuple[nn.Module, Variables]:
    """A network to compare with and its variables, by name or by file.

    A file that is not of one of `NETWORKS` raises `prism_jax.io.InputError`.
    """
    remedy = f"give a file of experiments.train_baseline, or one of {with_weights()}"
    path = pathlib.Path(located(name_or_path))
    if not path.is_file():
        raise InputError(name_or_path, "no such network", remedy)
    metadata, arrays = read_file(path)
    try:
        module = NETWORKS[metadata["network"]][metadata["size"]]
    except (KeyError, TypeError):
        raise InputError(path, "not a network to compare with", remedy) from None
    num_points: int = module.config.num_points  # pyright: ignore
    cloud = jnp.zeros((1, num_points, 3))
    made = jax.eval_shape(lambda: module.init(jax.random.key(0), cloud))
    wanted = {kind: made.get(kind, {}) for kind in ("params", "batch_stats")}
    return module, checked_arrays(arrays, wanted, path)
