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
    neighbors: Int[Array, "N k"] | None = None,
) -> Float[Array, ""]:
    """Eq. 5: agreement with PCA normals up to sign, and smoothness on the graph.

    `normals` are predicted unit normals of `points`, in the same frame. The PCA
    anchors and the graph have no gradient, so the loss is differentiable in
    `normals` alone. `neighbors` is the k-nearest-neighbour graph of the points,
    self included, where the caller already has it (then `k` is not used);
    otherwise it is found here, once for both terms. Edges of a point to itself do
    not count; a cloud of one point has no edges and no smoothness term.
    """
    points = jax.lax.stop_gradient(points)
    if neighbors is None:
        neighbors = knn(points, points, min(k, points.shape[0]))
    anchors = jax.lax.stop_gradient(pca_normals(points, neighbors=neighbors))
    agreement = jnp.mean(1.0 - jnp.abs(jnp.sum(normals * anchors, axis=-1)))
    return agreement + lambda_smooth * _roughness(normals, neighbors)


def _roughness(
    normals: Float[Array, "N 3"], neighbors: Int[Array, "N k"]
) -> Float[Array, ""]:
    """Mean L1 difference of the normals over the edges between distinct points."""
    # An edge of a point to itself adds nothing to the sum.
    difference = jnp.abs(normals[:, None] - normals[neighbors])
    is_edge = neighbors != jnp.arange(normals.shape[0])[:, None]
    return jnp.sum(difference) / jnp.maximum(jnp.sum(is_edge), 1)
