"""Neighbour indices of CRA-PCN's clouds, apart from features: of a query and a support
cloud at several resolutions, finest first, for all layers that look at the two."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.sampling import farthest_point_sample


class Level(NamedTuple):
    """One resolution of a pair of clouds."""

    # Rows of the query cloud that make up this resolution.
    query_rows: Int[Array, "... Q"]
    support_rows: Int[Array, "... S"]  # rows of the support cloud
    # For each query row here, its nearest support rows here.
    neighbors: Int[Array, "... Q k"]
    # For each query row here, the three nearest query rows of the next coarser
    # resolution; None at the coarsest.
    query_coarser: Int[Array, "... Q 3"] | None
    support_coarser: Int[Array, "... S 3"] | None  # the same for the support rows here


Pyramid = tuple[Level, ...]


def farthest_order(cloud: Float[Array, "N 3"], num_samples: int) -> Int[Array, " n"]:
    """Sampling as the reference does it, near-origin rule included."""
    return farthest_point_sample(cloud, num_samples, skip_near_origin=True)


def resolution_rows(
    order: Int[Array, " n"], num_points: int, rates: tuple[int, ...]
) -> tuple[Int[Array, " _"], ...]:
    """Rows of each resolution of a cloud: prefixes of its farthest-point order, and for
    rate 1 the whole cloud in its own order."""
    every = jnp.arange(num_points)
    return tuple(every if rate == 1 else order[: num_points // rate] for rate in rates)


def build_pyramid(
    query: Float[Array, "Q 3"],
    support: Float[Array, "S 3"],
    query_rows: tuple[Int[Array, " _"], ...],
    support_rows: tuple[Int[Array, " _"], ...],
    num_neighbors: tuple[int, ...],
    same: bool = False,
) -> Pyramid:
    """Neighbours of two clouds at every resolution; ``same`` if they are one."""
    levels = []
    for i, (q_rows, s_rows) in enumerate(zip(query_rows, support_rows, strict=True)):
        q, s = query[q_rows], support[s_rows]
        q_coarser = s_coarser = None
        if i + 1 < len(query_rows):
            coarser = query[query_rows[i + 1]]
            q_coarser = knn(q, coarser, 3)
            s_coarser = q_coarser if same else knn(s, coarser, 3)
        neighbors = knn(q, s, num_neighbors[i])
        levels.append(Level(q_rows, s_rows, neighbors, q_coarser, s_coarser))
    return tuple(levels)
