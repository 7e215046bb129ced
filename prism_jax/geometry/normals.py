"""Surface normals of a point cloud by principal component analysis."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from prism_jax.geometry.neighbors import knn

_SWEEPS = 5


def pca_normals(
    points: Float[Array, "N 3"],
    k: int = 16,
    neighbors: Int[Array, "M K"] | None = None,
) -> Float[Array, "M 3"]:
    """Unit normals: the direction of least variance among each point's neighbours.

    The neighbourhood is the ``k`` nearest points, self included (all of them if there
    are fewer), or the given ``neighbors`` indices, a row for each normal. Signs are
    arbitrary but repeatable. No gradient: that of an eigenvector is infinite at equal
    eigenvalues. Collinear neighbours give some direction across their line, coincident
    ones (1, 0, 0). Points must be finite; an empty cloud raises ValueError.

    H. Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992.
    """
    points = jax.lax.stop_gradient(points)
    if neighbors is None:
        neighbors = knn(points, points, min(k, points.shape[0]))
    # About one of them first: exact where the cloud is far from the origin.
    # Coordinate by coordinate, neighbours by points: every operation is then along
    # the points, as many as there are.
    around = [points[:, i][neighbors.T] for i in range(3)]
    offsets = [axis - axis[0] for axis in around]
    offsets = [offset - offset.mean(axis=0) for offset in offsets]
    covariance = [[(a * b).sum(axis=0) for b in offsets] for a in offsets]
    return _least_eigenvector(covariance)


def _least_eigenvector(matrix: list[list[Array]]) -> Float[Array, "N 3"]:
    """Of symmetric 3 x 3 matrices, given entry by entry: cyclic Jacobi rotations. A
    sweep roughly squares what is left off the diagonal; five reach float32. Much faster
    than ``eigh``, which calls LAPACK once a matrix."""
    largest = jnp.maximum(matrix[0][0], jnp.maximum(matrix[1][1], matrix[2][2]))
    scale = jnp.where(largest > 0, largest, 1.0)
    a = {(i, j): matrix[i][j] / scale for i in range(3) for j in range(i, 3)}
    one, zero = jnp.ones_like(scale), jnp.zeros_like(scale)
    vectors = [[one if i == j else zero for j in range(3)] for i in range(3)]

    def sweep(_, state):
        a, vectors = state
        for p, q in ((0, 1), (0, 2), (1, 2)):
            a, vectors = _rotate(a, vectors, p, q)
        return a, vectors

    a, vectors = jax.lax.fori_loop(0, _SWEEPS, sweep, (a, vectors))
    first, second, third = (a[i, i] for i in range(3))
    is_first = (first <= second) & (first <= third)
    columns = [
        jnp.where(is_first, row[0], jnp.where(second <= third, row[1], row[2]))
        for row in vectors
    ]
    normals = jnp.stack(columns, axis=-1)
    return normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)


def _rotate(a: dict, vectors: list, p: int, q: int) -> tuple[dict, list]:
    """The rotation in the plane of axes p and q that makes entry (p, q) zero. G. Golub,
    C. Van Loan, "Matrix computations", section 8.5."""
    r = 3 - p - q
    pr, qr = (min(p, r), max(p, r)), (min(q, r), max(q, r))
    off = a[p, q]
    divisor = jnp.where(off == 0, 1.0, 2 * off)
    ratio = (a[q, q] - a[p, p]) / divisor
    sign = jnp.where(ratio < 0, -1.0, 1.0)
    tangent = sign / (jnp.abs(ratio) + jnp.sqrt(ratio**2 + 1))
    tangent = jnp.where(off == 0, 0.0, tangent)
    cosine = jax.lax.rsqrt(tangent**2 + 1)
    sine = tangent * cosine
    rotated = {
        (p, p): a[p, p] - tangent * off,
        (q, q): a[q, q] + tangent * off,
        (r, r): a[r, r],
        (p, q): jnp.zeros_like(off),
        pr: cosine * a[pr] - sine * a[qr],
        qr: sine * a[pr] + cosine * a[qr],
    }
    vectors = [list(row) for row in vectors]
    for row in vectors:
        along, across = row[p], row[q]
        row[p] = cosine * along - sine * across
        row[q] = sine * along + cosine * across
    return rotated, vectors
