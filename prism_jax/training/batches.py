"""Batches of examples, in an order that a seed and a step number determine."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from prism_jax.data.corpus import Examples
from prism_jax.data.examples import dequantise
from prism_jax.geometry.workspace import Workspace


class Batch(NamedTuple):
    """Clouds in the unit workspace that each partial determines.

    Attributes:
      partial: measured points, in farthest-point order.
      complete: the whole surface, in farthest-point order.
      eye: where the sensor stood.
      half_extent: of the workspace, in the frame of the examples: what turns a
        distance here into one there.
    """

    partial: Float32[np.ndarray, "B N 3"]
    complete: Float32[np.ndarray, "B M 3"]
    eye: Float32[np.ndarray, "B 3"]
    half_extent: Float32[np.ndarray, " B"]


def make_batch(
    examples: Examples,
    rows: np.ndarray,
    num_partial: int,
    num_complete: int,
    margin: float,
    mirrored: np.ndarray | None = None,
) -> Batch:
    """Examples in their workspaces; ``mirrored`` rows have their x axis flipped.

    The procedural shapes stand upright with their front along y, so that a mirrored
    shape is one of its category too.
    """
    partial = dequantise(examples.partial[rows])
    complete = dequantise(examples.complete[rows, :num_complete])
    eye = examples.viewpoint[rows]
    if mirrored is not None:
        sign = np.ones((len(rows), 1, 3), np.float32)
        sign[mirrored, :, 0] = -1.0
        partial, complete, eye = partial * sign, complete * sign, eye * sign[:, 0]
    lower, upper = partial.min(axis=1), partial.max(axis=1)
    box = Workspace.from_bounds(lower, upper, margin)
    center = np.asarray(box.center, np.float32)[:, None]
    half_extent = np.asarray(box.half_extent, np.float32)
    scale = half_extent[:, None, None]
    return Batch(
        (partial[:, :num_partial] - center) / scale,
        (complete - center) / scale,
        (eye - center[:, 0]) / scale[:, 0],
        half_extent,
    )


class TrainingOrder:
    """Which examples a step sees: each once per epoch, freshly shuffled.

    A pure function of the seed and the step, so that a resumed run goes on with
    exactly the batches that it would have seen.
    """

    def __init__(self, num_examples: int, batch_size: int, seed: int):
        if num_examples < batch_size:
            raise ValueError(f"{num_examples} examples do not fill one batch")
        self._num_examples, self._batch_size, self._seed = (
            num_examples,
            batch_size,
            seed,
        )

    def rows(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the examples of a step, and which of them are mirrored."""
        per_epoch = self._num_examples // self._batch_size
        epoch, position = divmod(step, per_epoch)
        rng = np.random.default_rng([self._seed, epoch])
        order = rng.permutation(self._num_examples)
        mirrored = rng.random(self._num_examples) < 0.5
        chosen = slice(position * self._batch_size, (position + 1) * self._batch_size)
        return order[chosen], mirrored[chosen]
