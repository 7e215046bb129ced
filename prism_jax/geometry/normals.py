"""Surface normals of a point cloud by principal component analysis."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import knn


def pca_normals(
    points: Float[Array, "N 3"],
    k: int = 16,
    neighbors: Int[Array, "N K"] | None = None,
) -> Float[Array, "N 3"]:
    """Unit normals: the direction of least variance among each point's neighbours.

    The neighbourhood is the ``k`` nearest points, self included (all of them if there
    are fewer), or the given ``neighbors`` indices. Signs are arbitrary but repeatable.
    No gradient flows (the anchors of PRISM, Eq. 5): that of ``eigh`` is NaN at equal
    eigenvalues. Units do not matter. Collinear neighbours give some direction across
    their line, coincident ones (1, 0, 0). Points must be finite.

    H. Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992.
    """
    points = jax.lax.stop_gradient(points)
    if neighbors is None:
        neighbors = knn(points, points, min(k, points.shape[0]))
    # About the point itself first: exact where the cloud is far from the origin.
    offsets = points[neighbors] - points[:, None, :]
    offsets = offsets - offsets.mean(axis=1, keepdims=True)
    covariance = jnp.einsum("nki,nkj->nij", offsets, offsets)
    return jnp.linalg.eigh(covariance)[1][:, :, 0]
