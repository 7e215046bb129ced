"""What the encoder would look up, looked up once."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments import indices
from experiments.assets import CELLS
from experiments.indices import index_table
from prism_jax.data.augmentation import Augmentation
from prism_jax.data.pipeline import Framing, training_batches
from prism_jax.data.recordings import RecordedCells
from prism_jax.geometry.neighbors import knn
from prism_jax.models.backbone import partial_indices
from tests.training.conftest import Boxes, framed

__all__ = ["framed"]

FRAMING = Framing(64, 16, 1.4)


@pytest.fixture(scope="module")
def examples():
    return Boxes(20, seed=0)


@pytest.fixture(scope="module")
def config(minimal):
    return minimal.model.backbone


@pytest.fixture(scope="module")
def search(config):
    return jax.jit(lambda partials: partial_indices(partials, config))


@pytest.fixture(scope="module")
def table(examples, config):
    """Of twenty examples, eight at a time: the last batch is not full."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(indices, "_AT_ONCE", 8)
        return index_table(examples, FRAMING, config)


def assert_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


def test_each_row_is_what_the_encoder_would_look_up(table, examples, framed, search):
    assert {leaf.dtype for leaf in jax.tree.leaves(table)} == {np.dtype(np.uint16)}
    assert table.rows[0].shape[0] == 20
    assert_equal(table, search(framed(examples, range(20), FRAMING).partial))


def test_and_of_every_batch_mirrored_or_not(table, examples, framed, search):
    plain = framed(examples, range(20), FRAMING)
    batches = training_batches(examples, FRAMING, 20, seed=0, indices=table)
    mirrored = 0
    for _ in range(2):
        batch = next(batches)
        assert_equal(batch.indices, search(batch.partial))
        known = {partial.tobytes() for partial in plain.partial}
        mirrored += sum(partial.tobytes() not in known for partial in batch.partial)
    assert 5 < mirrored < 35


def test_they_name_the_same_points_of_what_is_turned_and_in_no_order(config):
    """The neighbours of the table are the nearest points of the turned partials too."""
    cells = RecordedCells(CELLS)
    assert cells[0].any_heading and not cells[0].ordered
    table = index_table(cells, FRAMING, config)

    def found_and_nearest(partial, indices):
        centers = partial[indices.rows[0]]
        found = partial[indices.neighbors[0]]
        nearest = partial[knn(centers, partial, found.shape[1])]
        return [((near - centers[:, None]) ** 2).sum(-1) for near in (found, nearest)]

    batch = next(training_batches(cells, FRAMING, 12, seed=0, indices=table))
    found, nearest = jax.vmap(found_and_nearest)(batch.partial, batch.indices)
    np.testing.assert_allclose(found, nearest, rtol=1e-3, atol=1e-5)


def test_a_table_that_is_too_large_is_not_made(table, examples, config, monkeypatch):
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(table))
    monkeypatch.setattr(indices, "MAX_BYTES", size - 1)
    assert index_table(examples, FRAMING, config) is None
    monkeypatch.setattr(indices, "MAX_BYTES", size)
    assert index_table(examples, FRAMING, config) is not None


def test_nor_one_of_partials_that_are_cropped_anew_every_time(examples, config):
    class Complete:
        categories, objects = examples.categories, examples.objects

        def __len__(self):
            return len(examples)

        def __getitem__(self, index):
            return examples[index]._replace(partial=None, eye=None)

    assert index_table(Complete(), FRAMING, config) is None


def test_nor_one_of_partials_that_are_spoiled_when_they_are_read(examples, config):
    spoiled = dataclasses.replace(FRAMING, augmentation=Augmentation(crop=0.5))
    assert index_table(examples, spoiled, config) is None
