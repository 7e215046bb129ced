"""Points so far from all others that they must not decide what is completed."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

TAIL = 100  # one point in so many is set aside at each end of each axis

OUTLIER_SIDES = 4.0
"""How far beyond the rest a point may lie, in longest sides of the rest's box. In the
data sets that ship or are made here the farthest lies at 1.8."""


def far_outliers(
    points: Float[Array | np.ndarray, "N 3"],
) -> Bool[Array | np.ndarray, " N"]:
    """Which points lie far outside the box that holds the bulk of the cloud.

    That box leaves out the lowest and the highest hundredth of each coordinate. A stray
    is farther from it, along some axis, than `OUTLIER_SIDES` longest sides. So up to
    1 % of the points can be found to be strays on each side. A cloud of fewer than
    `TAIL` points has none, and neither has one whose bulk is a single place. The points
    must be finite. NumPy arrays give NumPy arrays, and JAX arrays may be traced.
    """
    xp = jnp if isinstance(points, jax.Array) else np
    count = points.shape[0]
    rank = count // TAIL
    if rank == 0:
        return xp.zeros(count, bool)
    if xp is jnp:
        ordered = jnp.sort(points, axis=0)
    else:
        ordered = np.partition(points, (rank, count - 1 - rank), axis=0)
    lower, upper = ordered[rank], ordered[count - 1 - rank]
    side = (upper - lower).max()
    reach = OUTLIER_SIDES * side
    far = (points < lower - reach) | (points > upper + reach)
    return far.any(axis=-1) & (side > 0)
