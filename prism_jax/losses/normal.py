"""Surface-normal regularisation, Eq. 5."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.geometry.neighbors import knn
from prism_jax.geometry.normals import pca_normals


def normal_loss(
    normals: Float[Array, "N 3"],
    points: Float[Array, "N 3"],
    lambda_smooth: float = 0.1,
    k: int = 16,
    stride: int = 1,
) -> Float[Array, ""]:
    """Eq. 5: agreement with PCA normals up to sign, and smoothness on the graph.

    `normals` are predicted unit normals of `points`, in the same frame. The PCA anchors
    and the graph have no gradient, so the loss is differentiable in `normals` alone.
    The means are over every `stride`-th point, and its edges to the `k` nearest of all.
    Edges of a point to itself do not count.
    """
    points = jax.lax.stop_gradient(points)
    rows = jnp.arange(0, points.shape[0], stride)
    neighbors = knn(points[rows], points, min(k, points.shape[0]))
    anchors = jax.lax.stop_gradient(pca_normals(points, neighbors=neighbors))
    agreement = jnp.mean(1.0 - jnp.abs(jnp.sum(normals[rows] * anchors, axis=-1)))
    # An edge of a point to itself adds nothing to the sum.
    difference = jnp.abs(normals[rows][:, None] - normals[neighbors])
    is_edge = neighbors != rows[:, None]
    roughness = jnp.sum(difference) / jnp.maximum(jnp.sum(is_edge), 1)
    return agreement + lambda_smooth * roughness
