"""Which examples a step sees, and in what frame."""

import numpy as np
import pytest

from prism_jax.data.examples import dequantise
from prism_jax.geometry.workspace import Workspace
from prism_jax.training.batches import TrainingOrder, make_batch

MARGIN = 1.4
ROWS = np.array([3, 0, 7])


@pytest.mark.parametrize(("num_examples", "batch_size"), [(20, 4), (21, 4), (6, 6)])
def test_an_epoch_sees_each_example_once(num_examples, batch_size):
    order = TrainingOrder(num_examples, batch_size, seed=3)
    steps = num_examples // batch_size
    for epoch in range(3):
        batches = [order.rows(epoch * steps + i)[0] for i in range(steps)]
        seen = np.concatenate(batches)
        assert all(len(batch) == batch_size for batch in batches)
        assert len(np.unique(seen)) == len(seen) == steps * batch_size
        assert seen.min() >= 0
        assert seen.max() < num_examples


def test_every_epoch_is_shuffled_anew():
    order = TrainingOrder(100, 100, seed=0)
    epochs = [order.rows(step)[0] for step in range(3)]
    assert not np.array_equal(epochs[0], np.arange(100))
    assert not np.array_equal(epochs[0], epochs[1])
    assert not np.array_equal(epochs[1], epochs[2])
    assert not np.array_equal(TrainingOrder(100, 100, seed=1).rows(0)[0], epochs[0])


def test_rows_are_a_function_of_seed_and_step_alone():
    forwards, again = TrainingOrder(50, 8, seed=5), TrainingOrder(50, 8, seed=5)
    steps = range(15)
    expected = [forwards.rows(step) for step in steps]
    for step in reversed(steps):
        rows, mirrored = again.rows(step)
        assert np.array_equal(rows, expected[step][0])
        assert np.array_equal(mirrored, expected[step][1])


def test_half_the_examples_are_mirrored_and_others_each_time():
    order = TrainingOrder(1000, 1000, seed=0)
    first, second = order.rows(0)[1], order.rows(1)[1]
    assert first.dtype == bool
    # Five standard deviations of a fair coin.
    assert abs(first.mean() - 0.5) < 5 * 0.5 / np.sqrt(1000)
    assert not np.array_equal(first, second)


def test_too_few_examples_for_one_batch():
    with pytest.raises(ValueError, match="7 examples do not fill one batch"):
        TrainingOrder(7, 8, seed=0)


def test_frame_is_the_workspace_of_the_partial(examples):
    batch = make_batch(examples, ROWS, 64, 128, MARGIN)
    for i, row in enumerate(ROWS):
        partial = dequantise(examples.partial[row]).astype(np.float64)
        workspace = Workspace.from_points(partial, MARGIN)
        complete = dequantise(examples.complete[row]).astype(np.float64)
        eye = examples.viewpoint[row].astype(np.float64)
        assert batch.half_extent[i] == pytest.approx(workspace.half_extent)
        for mapped, original in [
            (batch.partial[i], partial[:64]),
            (batch.complete[i], complete[:128]),
            (batch.eye[i], eye),
        ]:
            assert mapped.dtype == np.float32
            np.testing.assert_allclose(mapped, workspace.to_unit(original), atol=1e-6)


def test_the_complete_cloud_does_not_decide_the_frame(examples):
    """At test time there is none."""
    expected = make_batch(examples, ROWS, 64, 128, MARGIN)
    other = examples._replace(complete=examples.complete // 3 + 99)
    changed = make_batch(other, ROWS, 64, 128, MARGIN)
    assert np.array_equal(changed.partial, expected.partial)
    assert np.array_equal(changed.eye, expected.eye)
    assert np.array_equal(changed.half_extent, expected.half_extent)
    assert not np.array_equal(changed.complete, expected.complete)


def test_nor_does_the_number_of_points_that_the_network_takes(examples):
    few = make_batch(examples, ROWS, 64, 128, MARGIN)
    many = make_batch(examples, ROWS, 512, 128, MARGIN)
    assert np.array_equal(few.half_extent, many.half_extent)
    assert np.array_equal(few.partial, many.partial[:, :64])


def test_clouds_keep_their_order(examples):
    """Prefixes of a farthest-point order are samples; a shuffle would end that."""
    batch = make_batch(examples, ROWS, 64, 128, MARGIN)
    spans = batch.partial[0] * batch.half_extent[0]
    stored = dequantise(examples.partial[ROWS[0], :64])
    np.testing.assert_allclose(spans - spans[0], stored - stored[0], atol=1e-6)


def test_a_mirrored_row_is_its_image_and_the_others_are_as_they_were(examples):
    plain = make_batch(examples, ROWS, 64, 128, MARGIN)
    chosen = np.array([False, True, False])
    mirrored = make_batch(examples, ROWS, 64, 128, MARGIN, chosen)
    flip = np.array([-1, 1, 1], np.float32)
    for a, b in zip(mirrored[:3], plain[:3], strict=True):
        assert np.array_equal(a[~chosen], b[~chosen])
        np.testing.assert_allclose(a[chosen], b[chosen] * flip, atol=1e-6)
    assert np.array_equal(mirrored.half_extent, plain.half_extent)


def test_stored_examples_are_not_changed(examples):
    before = [np.array(array) for array in examples[:3]]
    make_batch(examples, ROWS, 64, 128, MARGIN, np.array([True, True, True]))
    for a, b in zip(before, examples[:3], strict=True):
        assert np.array_equal(a, b)
