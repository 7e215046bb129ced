"""Searches by Pallas kernels, and Chamfer, against what XLA makes, on an NVIDIA GPU."""

import functools
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.measure import Compiled, Row, in_turn, row
from experiments.benchmarks.ops import cloud
from prism_jax.geometry import kernels
from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.sampling import farthest_point_sample
from prism_jax.io.errors import InputError
from prism_jax.losses.chamfer import chamfer

SIZES = (1024, 4096, 16384)
BATCH = 16
BATCHED = 4096
"""The largest cloud of which a batch is searched at once."""
NUM_NEIGHBORS = 16


def suite() -> Iterator[Row]:
    """Each kernel at every size, one cloud alone and a batch of the smaller ones.

    Chamfer stands beside a whole matrix of distances, which XLA need not keep: its
    form for a CPU takes XLA minutes to compile for a GPU. Raises InputError where
    there is no GPU.
    """
    if not kernels.on_gpu():
        fault = f"JAX sees no NVIDIA GPU, only {jax.default_backend()}"
        raise InputError("--suite=kernels", fault, "install '.[cuda13]' where one is")
    for size in SIZES:
        for name, (ours, theirs, peer) in _searches(size).items():
            for batch in (1, BATCH) if size <= BATCHED else (1,):
                clouds = [_clouds(size, batch, which) for which in range(2)]
                yield _compared(name, ours, theirs, peer, clouds)


def _searches(size: int) -> dict[str, tuple[Callable, Callable, str]]:
    many = functools.partial(knn, k=NUM_NEIGHBORS)
    as_on_cpu = "its form for a CPU"
    count = size // 8

    def farthest(points: jax.Array, _: jax.Array) -> jax.Array:
        return farthest_point_sample(points, count)

    gradient = jax.value_and_grad
    return {
        f"{NUM_NEIGHBORS} nearest neighbours": (many, _without(many), as_on_cpu),
        "Chamfer, value and gradient": (
            gradient(chamfer),
            gradient(_plain),
            "plain jax.numpy",
        ),
        f"farthest points, {count:,} of them": (
            farthest,
            _without(farthest),
            as_on_cpu,
        ),
    }


def _plain(a: jax.Array, b: jax.Array) -> jax.Array:
    squared = ((a[:, None] - b) ** 2).sum(-1)
    return squared.min(1).mean() + squared.min(0).mean()


def _without(function: Callable) -> Callable:
    """Traced as where there is no GPU."""

    def traced(*clouds: jax.Array) -> Any:
        with mock.patch.object(kernels, "on_gpu", lambda: False):
            return function(*clouds)

    return traced


def _clouds(size: int, batch: int, which: int) -> jax.Array:
    return jnp.asarray(np.stack([cloud(size, 2 * i + which) for i in range(batch)]))


def _compared(
    name: str, ours: Callable, theirs: Callable, peer: str, clouds: list[jax.Array]
) -> Row:
    both = [Compiled(jax.vmap(function), *clouds) for function in (ours, theirs)]
    times = in_turn(*both, seconds=0.5)
    batch, size, _ = clouds[0].shape
    name = f"{name}, {size:,}" + (f", {batch} clouds at once" if batch > 1 else "")
    return row(name, times[0], peer, times[1], **both[0].costs)
