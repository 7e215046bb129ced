"""Which examples a batch holds."""

import numpy as np
import pytest
from absl import flags

from prism_jax.data.datasets import open_dataset
from prism_jax.data.pipeline import Framing, training_batches
from prism_jax.data.source import Example
from prism_jax.io.errors import InputError

SMALL = Framing(4, 4, 1.4)


class Numbered:
    """Item i is told apart by its size, mirrored or not; `rows` are its indices."""

    categories = ("thing",)

    def __init__(self, count):
        self.count, self.objects = count, np.arange(count)
        self.rows = {"row": np.arange(count, dtype=np.uint16)}

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        points = np.tile(np.eye(4, 3, dtype=np.float32), (2, 1)) * (index + 1)
        eye = np.array([3, 0, 0], np.float32)
        return Example(points, points, eye, "thing", str(index), ordered=True)


def batches_of(source, size, count, **options):
    indices = getattr(source, "rows", None)
    options = {"seed": 3, "indices": indices, **options}
    batches = training_batches(source, SMALL, size, **options)
    return [next(batches) for _ in range(count)]


def rows(batches):
    return np.concatenate([batch.indices["row"] for batch in batches])


def mirrored(batches):
    """The sensor stands towards +x of every one."""
    return np.concatenate([batch.eye[:, 0] < 0 for batch in batches])


def equal(a, b):
    assert type(a) is type(b)
    assert (a.indices is None) == (b.indices is None)
    same = a.indices is None or np.array_equal(a.indices["row"], b.indices["row"])
    return same and all(map(np.array_equal, a[:4], b[:4]))


@pytest.mark.parametrize(("count", "size"), [(20, 4), (21, 4), (6, 6)])
def test_an_epoch_sees_each_example_once(count, size):
    """Also where a batch reaches into the next epoch."""
    seen = rows(batches_of(Numbered(count), size, 3 * count // size + 1))
    for epoch in range(3):
        once = seen[epoch * count : (epoch + 1) * count]
        assert np.array_equal(np.sort(once), np.arange(count))


def test_every_epoch_is_shuffled_anew():
    first, second, third = batches_of(Numbered(100), 100, 3)
    assert not np.array_equal(rows([first]), np.arange(100))
    assert not np.array_equal(rows([first]), rows([second]))
    assert not np.array_equal(rows([second]), rows([third]))
    other = batches_of(Numbered(100), 100, 1, seed=4)
    assert not np.array_equal(rows(other), rows([first]))


def test_half_are_mirrored_and_others_each_time():
    batches = batches_of(Numbered(1000), 500, 4)
    first, second = mirrored(batches[:2]), mirrored(batches[2:])
    # Five standard deviations of a fair coin.
    assert abs(first.mean() - 0.5) < 5 * 0.5 / np.sqrt(1000)
    first = first[np.argsort(rows(batches[:2]))]
    second = second[np.argsort(rows(batches[2:]))]
    assert abs(np.mean(first == second) - 0.5) < 5 * 0.5 / np.sqrt(1000)


def test_batches_are_a_function_of_seed_and_number_alone():
    for a, b in zip(*[batches_of(Numbered(10), 4, 6) for _ in "ab"], strict=True):
        assert equal(a, b)


def test_indices_travel_with_their_example():
    """Where the sensor stands in the workspace tells which example it is."""
    for batch in batches_of(Numbered(10), 4, 6):
        size = batch.indices["row"] + 1.0
        expected = abs(3 - 0.5 * size) / (0.7 * size)
        np.testing.assert_allclose(abs(batch.eye[:, 0]), expected, atol=1e-6)
        assert batch.indices["row"].dtype == np.uint16


@pytest.mark.parametrize("start", [0, 1, 7])
def test_a_later_start_goes_on_with_the_next_batch(start):
    source = Numbered(10)
    whole = training_batches(source, SMALL, 4, 3, indices=source.rows)
    expected = [next(whole) for _ in range(start + 4)][start:]
    later = training_batches(source, SMALL, 4, 3, indices=source.rows, start=start)
    for batch in expected:
        assert equal(next(later), batch)


@pytest.fixture
def flags_left_as_they_are():
    """Which Grain's workers read, and which only a launcher has parsed."""
    before = flags.FLAGS.is_parsed()
    yield
    if not before:
        flags.FLAGS.unparse_flags()


@pytest.mark.usefixtures("flags_left_as_they_are")
def test_and_so_it_does_where_another_process_reads(shapes_dir):
    """Whose batches are those of this process."""
    source = open_dataset("shapes", "train", shapes_dir)
    here = training_batches(source, SMALL, 3, 3)
    expected = [next(here) for _ in range(6)]
    batches = training_batches(source, SMALL, 3, 3, num_workers=1)
    for batch in expected[:4]:
        assert equal(next(batches), batch)
    batches = training_batches(source, SMALL, 3, 3, num_workers=1, start=4)
    for batch in expected[4:]:
        assert equal(next(batches), batch)


def test_too_few_examples_for_one_batch():
    with pytest.raises(InputError, match="7 examples do not fill a batch of 8"):
        batches_of(Numbered(7), 8, 1)
