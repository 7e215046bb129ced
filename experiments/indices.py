"""Encoder indices of a whole training set, made once before the training.

The samples and neighbours of a partial that never changes are the same in every epoch,
and the same for its mirror image.
"""

import concurrent.futures
import dataclasses
import os

import jax
import numpy as np
from tqdm import tqdm

from prism_jax.data.pipeline import Framing, frame_example, stack
from prism_jax.data.source import Source
from prism_jax.models.backbone import partial_indices
from prism_jax.models.config import BackboneConfig
from prism_jax.models.encoder import EncoderIndices

MAX_BYTES = 2**31
"""A larger table is not made: the steps then compute the indices of their batch."""
_AT_ONCE = 128


def index_table(
    source: Source, framing: Framing, config: BackboneConfig
) -> EncoderIndices | None:
    """Indices of every partial, 16 bits each, with a leading axis over the source.

    None if they would take more than `MAX_BYTES`, if 16 bits do not number a partial's
    points, or if partials change: cropped at random from complete clouds by a source
    that has no others.
    """
    if source[0].partial is None or config.num_points > 2**16:
        return None

    @jax.jit
    def compute(partials):
        indices = partial_indices(partials, config)
        return jax.tree.map(lambda rows: rows.astype(np.uint16), indices)

    shape = jax.ShapeDtypeStruct((len(source), config.num_points, 3), np.float32)
    table = jax.eval_shape(compute, shape)
    if sum(leaf.size * 2 for leaf in jax.tree.leaves(table)) > MAX_BYTES:
        return None
    table = jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), table)
    # They are the same in every heading, which takes longer to find than all else.
    framing = dataclasses.replace(framing, heading="given")

    def fill(start: int) -> int:
        rows = np.minimum(start + np.arange(_AT_ONCE), len(source) - 1)
        batch = stack([frame_example(source[int(row)], framing) for row in rows])
        found = jax.device_get(compute(batch.partial))
        for leaf, new in zip(*map(jax.tree.leaves, (table, found)), strict=True):
            leaf[rows] = new
        return int(rows[-1]) + 1 - start

    starts = range(0, len(source), _AT_ONCE)
    with (
        tqdm(total=len(source), desc="indices", unit="cloud", mininterval=2.0) as bar,
        concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool,
    ):
        for count in pool.map(fill, starts):
            bar.update(count)
    return table
