"""Surface-normal regularisation, Eq. 5."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.normals import pca_normals


def normal_loss(
    normals: Float[Array, "N 3"],
    points: Float[Array, "N 3"],
    lambda_smooth: float = 0.1,
    k: int = 16,
    neighbors: Int[Array, "n k"] | None = None,
    stride: int = 1,
) -> Float[Array, ""]:
    """Eq. 5: agreement with PCA normals up to sign, and smoothness on the graph.

    `normals` are predicted unit normals of `points`, in the same frame. The PCA
    anchors and the graph have no gradient, so the loss is differentiable in
    `normals` alone. The means are over every `stride`-th point, and its edges to any.
    `neighbors` are those points' k nearest among all, self included, where the caller
    already has them (then `k` is not used); otherwise they are found here, once for
    both terms. Edges of a point to itself do not count; a cloud of one point has no
    edges and no smoothness term.
    """
    points = jax.lax.stop_gradient(points)
    rows = jnp.arange(0, points.shape[0], stride)
    if neighbors is None:
        neighbors = knn(points[rows], points, min(k, points.shape[0]))
    anchors = jax.lax.stop_gradient(pca_normals(points, neighbors=neighbors))
    agreement = jnp.mean(1.0 - jnp.abs(jnp.sum(normals[rows] * anchors, axis=-1)))
    return agreement + lambda_smooth * _roughness(normals, rows, neighbors)


def _roughness(
    normals: Float[Array, "N 3"], rows: Int[Array, " n"], neighbors: Int[Array, "n k"]
) -> Float[Array, ""]:
    """Mean L1 difference of the normals over the edges between distinct points."""
    # An edge of a point to itself adds nothing to the sum.
    difference = jnp.abs(normals[rows][:, None] - normals[neighbors])
    is_edge = neighbors != rows[:, None]
    return jnp.sum(difference) / jnp.maximum(jnp.sum(is_edge), 1)
