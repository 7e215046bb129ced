"""Partial clouds cut from complete ones, as ShapeNet-55 is trained and tested with.

Yu et al., "PoinTr", ICCV 2021. Nothing here is differentiable.
"""

import numpy as np
from jaxtyping import Float, Float64

CROP_SHARES = {"easy": 0.25, "median": 0.5, "hard": 0.75}
"""Shares of the complete cloud that the three tests of ShapeNet-55 remove."""
CROP_VIEWPOINTS = np.array(
    [
        (1, 1, 1),
        (1, 1, -1),
        (1, -1, 1),
        (-1, 1, 1),
        (-1, -1, 1),
        (-1, 1, -1),
        (1, -1, -1),
        (-1, -1, -1),
    ],
    np.float64,
)
"""The fixed viewpoints of ShapeNet-55's tests, in the order of PoinTr's evaluation."""


def crop(
    complete: Float[np.ndarray, "M 3"], viewpoint: Float[np.ndarray, "3"], share: float
) -> Float[np.ndarray, "N 3"]:
    """The cloud without the `share` of its points that is nearest to the viewpoint:
    `int(share * M)` points go; the rest keeps its order. The benchmark tests with
    `CROP_SHARES` from each of `CROP_VIEWPOINTS`. A share outside [0, 1) raises
    ValueError."""
    if not 0 <= share < 1:
        raise ValueError("the share to crop must be at least 0 and below 1")
    gaps = np.sum((complete - viewpoint) ** 2, axis=1)
    nearest_first = np.argsort(gaps, kind="stable")
    return complete[np.sort(nearest_first[int(share * len(complete)) :])]


def random_crop(
    complete: Float[np.ndarray, "M 3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "N 3"], Float64[np.ndarray, "3"]]:
    """A crop as ShapeNet-55 trains with, and its viewpoint: a random direction, and a
    random share from the easiest to the hardest."""
    direction = rng.normal(size=3)
    viewpoint = direction / np.linalg.norm(direction)
    share = rng.uniform(CROP_SHARES["easy"], CROP_SHARES["hard"])
    return crop(complete, viewpoint, share), viewpoint
