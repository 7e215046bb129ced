"""The searches as Pallas kernels against their XLA forms, on an NVIDIA GPU."""

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
from prism_jax.geometry.neighbors import knn, nearest
from prism_jax.geometry.sampling import farthest_point_sample
from prism_jax.io.errors import InputError
from prism_jax.losses.chamfer import chamfer

SIZES = (1024, 4096, 16384, 65536)
BATCH = 16
BATCHED = 4096
"""The largest cloud of which a batch is searched at once."""
NEIGHBORS = 16


def suite() -> Iterator[Row]:
    """Each kernel at every size, one cloud alone and a batch of the smaller ones.

    Raises InputError where there is no GPU to run them on.
    """
    if not kernels.on_gpu():
        fault = f"JAX sees no NVIDIA GPU, only {jax.default_backend()}"
        raise InputError("--suite=kernels", fault, "install '.[cuda]' on one that has")
    for size in SIZES:
        for name, function in _searches(size).items():
            for batch in (1, BATCH) if size <= BATCHED else (1,):
                yield from _compared(name, function, size, batch)


def _searches(size: int) -> dict[str, Callable[[jax.Array, jax.Array], Any]]:
    count = size // 8
    searches = {
        "nearest neighbours": nearest,
        f"{NEIGHBORS} nearest neighbours": functools.partial(knn, k=NEIGHBORS),
        "Chamfer, value and gradient": jax.value_and_grad(chamfer),
    }
    if size <= kernels.MAX_FARTHEST_POINTS:
        name = f"farthest points, {count:,} of them"
        searches[name] = lambda points, _: farthest_point_sample(points, count)
    return searches


def _compared(name: str, function: Any, size: int, batch: int) -> Iterator[Row]:
    clouds = [
        jnp.asarray(np.stack([cloud(size, 2 * i + which) for i in range(batch)]))
        for which in range(2)
    ]
    ours = Compiled(jax.vmap(function), *clouds)
    with mock.patch.object(kernels, "on_gpu", lambda: False):
        theirs = Compiled(jax.vmap(lambda *given: function(*given)), *clouds)
    times = in_turn(ours, theirs, seconds=1.0)
    name = f"{name}, {size:,}" + (f", {batch} clouds at once" if batch > 1 else "")
    yield row(name, times[0], "as XLA has it", times[1], **ours.costs)
