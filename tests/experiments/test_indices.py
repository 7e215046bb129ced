"""What the encoder would look up, looked up once."""

import jax
import numpy as np
import pytest

from experiments import indices
from experiments.assets import CELLS
from experiments.indices import index_table
from prism_jax.data.pipeline import Framing, training_batches
from prism_jax.data.recordings import RecordedCells
from prism_jax.models.backbone import partial_indices
from tests.training.conftest import Boxes, framed

__all__ = ["framed"]

FRAMING = Framing(64, 16, 1.4)


@pytest.fixture(scope="module", autouse=True)
def few_at_once():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(indices, "_AT_ONCE", 8)
        yield


@pytest.fixture(scope="module")
def examples():
    return Boxes(20, seed=0)


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.model.backbone


@pytest.fixture(scope="module")
def table(examples, config):
    """Of twenty examples, eight at a time: the last batch is not full."""
    return index_table(examples, FRAMING, config)


def assert_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


def test_each_row_is_what_the_encoder_would_look_up(table, examples, framed, config):
    """Of every batch too, mirrored or not."""
    search = jax.jit(lambda partials: partial_indices(partials, config))
    assert {leaf.dtype for leaf in jax.tree.leaves(table)} == {np.dtype(np.uint16)}
    plain = framed(examples, range(20), FRAMING)
    assert_equal(table, search(plain.partial))
    batches = training_batches(examples, FRAMING, 20, seed=0, indices=table)
    known, mirrored = {partial.tobytes() for partial in plain.partial}, 0
    for _ in range(2):
        batch = next(batches)
        assert_equal(batch.indices, search(batch.partial))
        mirrored += sum(partial.tobytes() not in known for partial in batch.partial)
    assert 5 < mirrored < 35


def test_they_name_the_same_points_of_what_is_turned_and_in_no_order(config):
    """The neighbours of the table are the nearest points of the turned partials too."""
    cells = RecordedCells(CELLS)
    assert cells[0].any_heading and not cells[0].ordered
    table = index_table(cells, FRAMING, config)
    batch = next(training_batches(cells, FRAMING, 12, seed=0, indices=table))
    given = batch.partial, batch.indices.rows[0], batch.indices.neighbors[0]
    for partial, centers, neighbors in zip(*given, strict=True):
        squared = ((partial[centers][:, None] - partial) ** 2).sum(-1)
        found = np.take_along_axis(squared, neighbors.astype(int), axis=1)
        nearest = np.sort(squared, axis=1)[:, : found.shape[1]]
        np.testing.assert_allclose(found, nearest, rtol=1e-3, atol=1e-5)


def test_none_is_made_if_it_is_too_large_or_partials_change(
    table, examples, config, monkeypatch
):
    complete = [examples[0]._replace(partial=None, eye=None)]
    assert index_table(complete, FRAMING, config) is None
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(table))
    monkeypatch.setattr(indices, "MAX_BYTES", size - 1)
    assert index_table(examples, FRAMING, config) is None
