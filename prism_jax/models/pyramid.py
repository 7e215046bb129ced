"""Neighbour indices of CRA-PCN's clouds, apart from features: of a query and a support
cloud at several resolutions, finest first, for all layers that look at the two."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.sampling import farthest_point_sample
from prism_jax.models.layers import over_batch


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


def sampled_rows(
    clouds: Float[Array, "... N 3"], num_samples: int
) -> Int[Array, "... num_samples"]:
    """Each cloud's first rows in farthest-point order, as the reference samples it, its
    near-origin rule included."""
    return over_batch(
        lambda cloud: farthest_point_sample(cloud, num_samples, skip_near_origin=True)
    )(clouds)


def build_pyramid(
    query: Float[Array, "Q 3"],
    support: Float[Array, "S 3"],
    query_order: Int[Array, " q"],
    support_order: Int[Array, " s"],
    rates: tuple[int, ...],
    num_neighbors: tuple[int, ...],
) -> Pyramid:
    """Neighbours of two clouds, which may be one, at every resolution: prefixes of
    their farthest-point orders, and for rate 1 each whole cloud in its own order."""

    def rows(cloud: Array, order: Array) -> list[Array]:
        size = cloud.shape[0]
        return [jnp.arange(size) if r == 1 else order[: size // r] for r in rates]

    same = query is support
    query_rows = rows(query, query_order)
    support_rows = query_rows if same else rows(support, support_order)
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
