"""How far apart the points of a cloud lie, in NumPy and double precision."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

NUM_NEAR = 8  # neighbours that a density is taken from


def median_spacing(cloud: Float[np.ndarray, "N 3"]) -> float:
    """Median distance of a distinct point to its nearest other; infinite for one."""
    distinct = np.unique(cloud, axis=0)
    if len(distinct) < 2:
        return np.inf
    return float(np.median(KDTree(distinct).query(distinct, k=2)[0][:, 1]))


def surface_density(cloud: Float[np.ndarray, "N 3"]) -> float:
    """Points a square unit, where the cloud is as dense as usual.

    By the eighth neighbour: the nearest ones of a LiDAR's points all lie on one line.
    Zero for a cloud of fewer than nine distinct points.
    """
    distinct = np.unique(cloud, axis=0)
    if len(distinct) <= NUM_NEAR:
        return 0.0
    apart = KDTree(distinct).query(distinct, k=NUM_NEAR + 1)[0][:, -1]
    return float(NUM_NEAR / (np.pi * np.median(apart) ** 2))
