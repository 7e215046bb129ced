"""Which examples a batch holds."""

import numpy as np
import pytest
from absl import flags

from prism_jax.data.datasets import open_dataset
from prism_jax.data.pipeline import Framing, training_batches
from prism_jax.data.source import Example

SMALL = Framing(4, 4, 1.4)


class Numbered:
    """Item i is told apart by the height of its sensor, mirrored or not."""

    categories = ("thing",)

    def __init__(self, count):
        self.count, self.objects = count, np.arange(count)

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        points = np.tile(np.eye(4, 3, dtype=np.float32), (2, 1))
        eye = np.array([3, 0, 0.01 * index], np.float32)
        return Example(points, points, eye, "thing", str(index), ordered=True)


def batches_of(source, size, count, **options):
    batches = training_batches(source, SMALL, size, **{"seed": 3, **options})
    return [next(batches) for _ in range(count)]


def rows(batches):
    """The workspace's centre is at 0.5, its half side 0.7."""
    height = np.concatenate([0.7 * batch.eye[:, 2] + 0.5 for batch in batches])
    return np.rint(100 * height).astype(int)


def assert_equal(found, expected):
    for a, b in zip(found, expected, strict=True):
        assert all(map(np.array_equal, a[:4], b[:4]))


@pytest.mark.parametrize(("count", "size"), [(21, 4), (6, 6)])
def test_an_epoch_sees_each_example_once_in_an_order_of_its_own(count, size):
    """Also where a batch reaches into the next epoch."""
    seen = rows(batches_of(Numbered(count), size, 3 * count // size + 1))
    epochs = [seen[epoch * count : (epoch + 1) * count] for epoch in range(3)]
    other = rows(batches_of(Numbered(count), size, count // size + 1, seed=4))
    epochs.append(other[:count])
    for epoch in epochs:
        np.testing.assert_array_equal(np.sort(epoch), np.arange(count))
    orders = {tuple(order) for order in (range(count), *epochs)}
    assert len(orders) == 5


def test_half_are_mirrored_and_others_each_time():
    """The sensor stands towards +x of every one."""
    batches = batches_of(Numbered(200), 100, 4)
    mirrored = [np.concatenate([b.eye[:, 0] < 0 for b in batches[:2]])]
    mirrored.append(np.concatenate([b.eye[:, 0] < 0 for b in batches[2:]]))
    first, second = (
        flipped[np.argsort(rows(part))]
        for flipped, part in zip(mirrored, (batches[:2], batches[2:]), strict=True)
    )
    # Four standard deviations of a fair coin.
    for share in (first.mean(), second.mean(), np.mean(first == second)):
        assert abs(share - 0.5) < 4 * 0.5 / np.sqrt(200)


def test_a_later_start_goes_on_with_the_next_batch():
    expected = batches_of(Numbered(10), 4, 9)
    for start in (0, 1, 7):
        later = batches_of(Numbered(10), 4, 2, start=start)
        assert_equal(later, expected[start : start + 2])


@pytest.fixture
def flags_left_as_they_are():
    """Which Grain's workers read, and which only a launcher has parsed."""
    before = flags.FLAGS.is_parsed()
    yield
    if not before:
        flags.FLAGS.unparse_flags()


@pytest.mark.usefixtures("flags_left_as_they_are")
def test_batches_read_by_another_process_are_the_same(shapes_dir):
    source = open_dataset("shapes", "train", shapes_dir)
    expected = batches_of(source, 3, 6)
    assert_equal(batches_of(source, 3, 2, num_workers=1, start=4), expected[4:])
