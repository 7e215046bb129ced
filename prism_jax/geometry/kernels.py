"""Searches as GPUs do them, in Pallas kernels (Triton backend) but for the nearest.

What XLA makes is bound by launches (farthest points: some for every sample) or by
memory (neighbours: distances written and read again). A kernel is launched once, and
distances never leave registers. The results are those of the forms for a CPU, ties
included, between which `prism_jax.geometry.neighbors` and `sampling` choose by
platform. ``interpret=True`` runs a kernel without a GPU, for tests.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from prism_jax.geometry.extrema import inserted

MAX_FARTHEST_POINTS = 16384  # of a cloud that one program holds in its registers

_QUERIES = 128


def nearest_indices(
    query: Float[Array, "N 3"], support: Float[Array, "M 3"]
) -> Int[Array, " N"]:
    """Index of each query's nearest support point; ties go to the lowest. XLA reduces
    the distances as it makes them (docs/findings.md, "Speed and numbers")."""
    squared = ((query[:, None] - support) ** 2).sum(-1)
    return jax.lax.argmin(squared, 1, jnp.int32)


def knn_indices(
    query: Float[Array, "N 3"],
    support: Float[Array, "M 3"],
    k: int,
    interpret: bool = False,
) -> Int[Array, "N k"]:
    """Indices of the k nearest support points, nearest first; k is at most M. Ties go
    to the lowest index."""
    # Here, not above: what no CPU needs takes a quarter of a second.
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    queries = _rows(query, _QUERIES)
    supports = support.T
    num_supports = support.shape[0]

    def kernel(query_ref, support_ref, index_ref):
        x, y, z = (query_ref[i, :] for i in range(3))

        def point(j, best):
            a, b, c = (support_ref[i, j] for i in range(3))
            squared = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2
            # After the first points hardly one enters any of the lists.
            enters = jnp.max((squared < best[0][-1]).astype(jnp.int32)) > 0
            index = jnp.full(_QUERIES, j, jnp.int32)
            insert = functools.partial(inserted, new=squared, index=index)
            return jax.lax.cond(enters, insert, lambda best: best, best)

        farthest = jnp.full(_QUERIES, jnp.inf, query.dtype)
        none = jnp.zeros(_QUERIES, jnp.int32)
        start = ((farthest,) * k, (none,) * k)
        _, indices = jax.lax.fori_loop(0, num_supports, point, start)
        for rank in range(k):
            index_ref[rank, :] = indices[rank]

    call = pl.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct((k, queries.shape[1]), jnp.int32),
        grid=(queries.shape[1] // _QUERIES,),
        in_specs=[
            pl.BlockSpec((3, _QUERIES), lambda i: (0, i)),
            pl.BlockSpec(supports.shape, lambda i: (0, 0)),
        ],
        out_specs=pl.BlockSpec((k, _QUERIES), lambda i: (0, i)),
        compiler_params=triton.CompilerParams(num_warps=4),
        interpret=interpret,
    )
    return call(queries, supports).T[: query.shape[0]]


def farthest_indices(
    points: Float[Array, "N 3"],
    chosen_from: Bool[Array, " N"],
    start: Int[Array, ""],
    num_samples: int,
    interpret: bool = False,
) -> Int[Array, " num_samples"]:
    """Farthest-point sampling from ``start``, among the points that may be chosen. One
    program holds the whole cloud, up to `MAX_FARTHEST_POINTS`."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    size = pl.next_power_of_2(points.shape[0])
    cloud = _rows(points, size)
    allowed = jnp.pad(chosen_from.astype(jnp.int32), (0, size - points.shape[0]))
    first = jnp.reshape(start, (1,))

    def kernel(cloud_ref, allowed_ref, first_ref, sample_ref):
        x, y, z = (cloud_ref[i, :] for i in range(3))
        may = allowed_ref[...] > 0

        def add(i, state):
            distances, last = state
            sample_ref[i] = last
            a, b, c = (cloud_ref[axis, last] for axis in range(3))
            squared = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2
            distances = jnp.minimum(distances, squared)
            candidates = jnp.where(may, distances, -1.0)
            return distances, jax.lax.argmax(candidates, 0, jnp.int32)

        begin = (jnp.full(size, jnp.inf, points.dtype), first_ref[0])
        jax.lax.fori_loop(0, num_samples, add, begin)

    call = pl.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct((num_samples,), jnp.int32),
        compiler_params=triton.CompilerParams(num_warps=16 if size >= 4096 else 4),
        interpret=interpret,
    )
    return call(cloud, allowed, first)


def on_gpu() -> bool:
    """Whether kernels are to be traced at all beside their XLA forms."""
    return jax.default_backend() == "gpu"


def by_platform(
    kernel: Callable[..., Array], fallback: Callable[..., Array], *arguments: Array
) -> Array:
    """The kernel where the computation runs on an NVIDIA GPU, else the fallback."""
    if not on_gpu():
        return fallback(*arguments)
    return jax.lax.platform_dependent(*arguments, cuda=kernel, default=fallback)


def _rows(points: Array, multiple: int) -> Array:
    """Coordinates as three rows, filled up with zeros to a multiple of points."""
    padding = -points.shape[0] % multiple
    return jnp.pad(points, ((0, padding), (0, 0))).T
