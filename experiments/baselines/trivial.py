"""Completions that need no network: what a trained one must beat.

All in the unit workspace, which the partial alone determines.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from prism_jax.data.pipeline import with_partial
from prism_jax.data.source import Source
from prism_jax.geometry.sampling import resample
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError
from prism_jax.models.layers import over_batch


def mirrored(
    partial: Float[Array, "*batch N 3"], num_outputs: int
) -> Float[Array, "*batch M 3"]:
    """The partial together with its mirror image across the plane x = 0.

    Left and right are along x in objects in canonical pose. The plane goes through
    the middle of the workspace, that is of the partial's bounding box, and not of the
    object, whose middle only the complete cloud would tell. Exactly `num_outputs`
    points: of more, the first in farthest-point order; fewer are repeated.

    Differentiable in the points that are kept. An empty cloud raises ValueError; NaN
    coordinates are kept or left out as the sampling has it.
    """
    if partial.shape[-2] == 0:
        raise ValueError("an empty cloud has no mirror image")
    sign = jnp.array([-1, 1, 1], partial.dtype)
    both = jnp.concatenate([partial, partial * sign], axis=-2)
    return over_batch(lambda cloud: resample(cloud, num_outputs))(both)


def training_mean(
    source: Source, margin: float, num_outputs: int, seed: int = 0
) -> Float32[np.ndarray, "M 3"]:
    """One fixed cloud for every partial: a sample of the mean of the training shapes.

    The mean is that of distributions: each example, in the workspace of its partial
    with this `margin`, spreads its mass evenly over the points of its complete cloud.
    One point is drawn of each of `num_outputs` examples chosen at random, or, where
    there are fewer, as many of each as that makes, give or take one. A farthest-point
    sample of all the clouds together would follow the few that reach far out of their
    workspaces.

    A function of the arguments alone. An example without a partial is cropped at
    random, as in training; one without a complete cloud, and a source without
    examples, raises InputError.
    """
    if len(source) == 0:
        raise InputError("data", "no examples", "use a data set with examples")
    rng = np.random.default_rng(seed)
    rows = np.resize(rng.permutation(len(source)), num_outputs)
    points = np.empty((num_outputs, 3), np.float32)
    # Of a small source every row comes up many times.
    read = functools.lru_cache(256)(source.__getitem__)
    for point, row in zip(points, rows, strict=True):
        example = with_partial(read(int(row)), rng)
        assert example.partial is not None and example.complete is not None
        workspace = Workspace.from_points(example.partial, margin)
        point[:] = workspace.to_unit(rng.choice(example.complete))
    return points
