"""Exact nearest neighbours, and interpolation from them.

The searches are exact and brute force, in two levels: the minimum over short runs of
the support is fused and vectorised, and only the runs that can hold a neighbour are
looked at point by point. Differences of coordinates are taken directly, since
``|x|^2 + |y|^2 - 2xy`` cancels for close points. On a GPU, kernels of one level.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from prism_jax.geometry import kernels
from prism_jax.geometry.extrema import first_true, inserted
from prism_jax.geometry.precision import exact_products

_NEAREST_RUN = 32
_KNN_RUN = 8
_DIRECT_SUPPORT = 256
_LISTED_COLUMNS = 512
_LISTED_K = 32
_NEAREST_PAIRS = 1 << 22
_KNN_PAIRS = 1 << 24
_REDUCED_PAIRS = 1 << 28


def nearest(
    query: Float[Array, "N 3"], support: Float[Array, "M 3"]
) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
    """Squared distance to, and index of, each query's nearest support point.

    The distance is differentiable, any number of times, in both clouds through the
    winning pair alone: the search itself has no derivative. Ties go to the lowest
    index. Memory is linear in N + M. Coordinates must be finite; an empty support
    raises ValueError.
    """
    _require_points(support)
    query, support = jnp.asarray(query), jnp.asarray(support)
    indices = kernels.by_platform(
        functools.partial(_by_rows, kernels.nearest_indices, _REDUCED_PAIRS),
        functools.partial(_by_rows, _nearest_indices, _NEAREST_PAIRS),
        *jax.lax.stop_gradient((query, support)),
    )
    return ((query - support[indices]) ** 2).sum(-1), indices


def knn(
    query: Float[Array, "N 3"], support: Float[Array, "M 3"], k: int
) -> Int[Array, "N k"]:
    """Indices of the k nearest support points of each query, nearest first.

    A query that is itself a support point finds itself, or copies of itself, of which
    those with the lowest indices come first. No gradient. Where the support holds fewer
    than k points, the farthest one found is repeated. Coordinates must be finite; an
    empty support raises ValueError.
    """
    _require_points(support)
    found = min(k, support.shape[0])
    clouds = jax.lax.stop_gradient((jnp.asarray(query), jnp.asarray(support)))
    search = functools.partial(_knn_indices, k=found)
    indices = kernels.by_platform(
        functools.partial(kernels.knn_indices, k=found),
        functools.partial(_by_rows, search, _KNN_PAIRS),
        *clouds,
    )
    last = jnp.repeat(indices[:, -1:], k - found, axis=1)
    return jnp.concatenate([indices, last], axis=1)


@exact_products
def three_point_interpolate(
    query: Float[Array, "N 3"],
    support: Float[Array, "M 3"],
    features: Float[Array, "M C"],
    neighbors: Int[Array, "N 3"],
) -> Float[Array, "N C"]:
    """Features at the queries, by inverse squared distance from three supports.

    Weights are ``1 / (d^2 + 1e-8)``, normalised (PointNet++, section 3.4, as CRA-PCN
    uses it). ``neighbors`` are the three nearest supports. Differentiable in the other
    three arrays.
    """
    offsets = query[:, None] - support[neighbors]
    weights = 1.0 / ((offsets**2).sum(-1) + 1e-8)
    weights = weights / weights.sum(-1, keepdims=True)
    return jnp.einsum("nk,nkc->nc", weights, features[neighbors])


def _require_points(cloud: Array | np.ndarray) -> None:
    if cloud.shape[0] == 0:
        raise ValueError("a search needs at least one point to find")


def _by_rows(
    search: Callable[[Array, Array], Array],
    pairs_at_once: int,
    query: Array,
    support: Array,
) -> Array:
    """Runs a search over blocks of queries, to bound its memory."""
    if query.shape[0] * support.shape[0] <= pairs_at_once:
        return search(query, support)
    return jax.lax.map(
        lambda point: search(point[None], support)[0],
        query,
        batch_size=max(1, pairs_at_once // support.shape[0]),
    )


def _runs(support: Array, length: int) -> Array:
    """The support cut into equal runs, the last one padded with infinity."""
    padding = -support.shape[0] % length
    padded = jnp.pad(support, ((0, padding), (0, 0)), constant_values=jnp.inf)
    return padded.reshape(-1, length, 3)


def _squared_distances(query: Array, points: Array) -> Array:
    """Sum over the axes written out, so that it fuses into what reads it."""
    x, y, z = ((query[..., i] - points[..., i]) ** 2 for i in range(3))
    return x + y + z


def _run_minima(query: Array, runs: Array) -> Array:
    """Least squared distance of each query to each run. The minimum is taken member by
    member, over vectors of runs. A gather lays the members out for it: XLA would fuse a
    transposition, and read with a stride."""
    number, length, _ = runs.shape
    rows = np.arange(number * length).reshape(number, length).T
    members = runs.reshape(-1, 3)[rows.reshape(-1)].reshape(length, number, 3)
    distances = [_squared_distances(query[:, None], member) for member in members]
    return functools.reduce(jnp.minimum, distances)


def _nearest_indices(query: Array, support: Array) -> Array:
    runs = _runs(support, _NEAREST_RUN)
    minima = _run_minima(query, runs)
    run = first_true(minima == minima.min(-1, keepdims=True))
    distances = _squared_distances(query[:, None], runs[run])
    inside = first_true(distances == distances.min(-1, keepdims=True))
    return run * _NEAREST_RUN + inside


def _knn_indices(query: Array, support: Array, k: int) -> Array:
    if support.shape[0] <= max(_DIRECT_SUPPORT, k * _KNN_RUN):
        if k > _LISTED_K:
            distances = _squared_distances(query[:, None], support[None])
            return _k_lowest_columns(distances, k)
        return _k_lowest(lambda point: _squared_distances(query, point), support, k)
    # The k nearest lie in the k runs whose nearest points are nearest.
    runs = _runs(support, _KNN_RUN)
    run = jnp.sort(_k_lowest_columns(_run_minima(query, runs), k), axis=-1)
    distances = _squared_distances(query[:, None, None], runs[run])
    best = _k_lowest_columns(distances.reshape(len(query), -1), k)
    members = run[:, :, None] * _KNN_RUN + jnp.arange(_KNN_RUN, dtype=jnp.int32)
    return jnp.take_along_axis(members.reshape(len(query), -1), best, axis=-1)


def _k_lowest_columns(values: Float[Array, "N M"], k: int) -> Int[Array, "N k"]:
    """Columns of the k lowest values of each row."""
    if values.shape[1] > _LISTED_COLUMNS or k > _LISTED_K:
        return jax.lax.top_k(-values, k)[1]
    # Without the barriers XLA fuses what made the values into every step.
    values = jax.lax.optimization_barrier(values)
    columns = jax.lax.optimization_barrier(values.T)
    return _k_lowest(lambda column: column, columns, k, unroll=1)


def _k_lowest(
    value_fn: Callable[[Array], Float[Array, " N"]],
    members: Shaped[Array, "M ..."],
    k: int,
    unroll: int = 2,
) -> Int[Array, "N k"]:
    """For each of N queries, the k members of lowest value, lowest first.

    Of equal values the first comes first. ``value_fn`` gives all queries' values of one
    member, which is inserted into their sorted lists: that runs along the queries,
    where ``top_k`` sorts row by row.
    """

    def insert(lists, indexed):
        index, member = indexed
        return inserted(lists, value_fn(member), index), None

    empty = jax.eval_shape(value_fn, members[0])
    lists = (
        (jnp.full(empty.shape, jnp.inf, empty.dtype),) * k,
        (jnp.zeros(empty.shape, jnp.int32),) * k,
    )
    rows = jnp.arange(len(members), dtype=jnp.int32)
    (_, indices), _ = jax.lax.scan(insert, lists, (rows, members), unroll=unroll)
    return jnp.stack(indices, axis=-1)
