"""The partial and its mirror image, and the mean of the training shapes."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.baselines.trivial import mirrored, training_mean
from prism_jax.data.source import Example
from prism_jax.io.errors import InputError

RNG = np.random.default_rng(0)
PARTIAL = RNG.uniform(-0.7, 0.7, (3, 20, 3)).astype(np.float32)
FLIP = np.array([-1, 1, 1], np.float32)
BOTH = np.concatenate([PARTIAL, PARTIAL * FLIP], axis=1)


@pytest.fixture(scope="module")
def mirrored_fn(quick_jit):
    return quick_jit(mirrored, static_argnums=1)


def sorted_rows(cloud):
    return np.asarray(sorted(map(tuple, np.asarray(cloud))))


@pytest.mark.parametrize("num_outputs", [13, 40])
def test_mirrored_is_a_farthest_point_sample_of_both(mirrored_fn, num_outputs):
    """No point of either is farther from the chosen ones than the next chosen."""
    made = np.asarray(mirrored_fn(jnp.asarray(PARTIAL), num_outputs))
    assert made.shape == (3, num_outputs, 3)
    for cloud, both in zip(made, BOTH, strict=True):
        assert KDTree(both).query(cloud)[0].max() == 0
        assert len(np.unique(cloud, axis=0)) == num_outputs
        for n in range(1, num_outputs):
            chosen = KDTree(cloud[:n])
            farthest = chosen.query(both)[0].max()
            assert chosen.query(cloud[n])[0] == pytest.approx(farthest, rel=1e-6)


def test_too_few_points_are_repeated(mirrored_fn, num_outputs=100):
    """All of both clouds first, and then again from the first on."""
    made = np.asarray(mirrored_fn(jnp.asarray(PARTIAL), num_outputs))
    assert made.shape == (3, num_outputs, 3)
    for cloud, both in zip(made, BOTH, strict=True):
        assert np.array_equal(sorted_rows(cloud[:40]), sorted_rows(both))
        assert np.array_equal(cloud, np.resize(cloud[:40], (num_outputs, 3)))


def test_mirroring_the_partial_changes_nothing(mirrored_fn):
    one = mirrored_fn(jnp.asarray(PARTIAL), 40)
    other = mirrored_fn(jnp.asarray(PARTIAL * FLIP), 40)
    for a, b in zip(one, other, strict=True):
        assert np.array_equal(sorted_rows(a), sorted_rows(b))


def test_a_half_is_made_whole(mirrored_fn):
    """A symmetric object seen from the left."""
    left = np.abs(PARTIAL[0]) * [-1, 1, 1]
    whole = np.concatenate([left, left * FLIP])
    found = mirrored_fn(jnp.asarray(left, jnp.float32), 40)
    assert KDTree(found).query(whole)[0].max() < 1e-6


@pytest.mark.parametrize(
    "cloud",
    [
        np.tile([[0.3, -0.2, 0.7]], (20, 1)),
        np.linspace(-1, 1, 20)[:, None] * [1.0, 2.0, -1.0],
        np.linspace(-1, 1, 20)[:, None] * [0.0, 2.0, -1.0],
        RNG.uniform(-1, 1, (20, 3)) + 1e4,
    ],
    ids=["one point many times", "collinear", "in the plane", "far away"],
)
def test_degenerate_clouds(mirrored_fn, cloud):
    """Every point is one of both clouds, and each of those has one."""
    cloud = cloud.astype(np.float32)
    both = np.concatenate([cloud, cloud * FLIP])
    made = np.asarray(mirrored_fn(jnp.asarray(cloud), 40))
    assert np.array_equal(np.unique(made, axis=0), np.unique(both + 0.0, axis=0))


def test_a_cloud_of_no_points():
    with pytest.raises(ValueError, match="empty"):
        mirrored(jnp.zeros((2, 0, 3)), 4)


class Single:
    """A source of one example."""

    categories, objects = ("thing",), np.zeros(1, int)

    def __init__(self, complete, partial):
        self.example = Example(complete, partial, None, "thing", "the one")

    def __len__(self):
        return 1

    def __getitem__(self, index):
        return self.example


class Shapes:
    """Boxes of eight corners, each somewhere else and of another size; their partials
    are two opposite corners. With `mark`, box i is i + 2 times as high as that."""

    categories = ("thing",)
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(-1, 3)

    def __init__(self, count, mark=False):
        self.count, self.mark = count, mark
        self.objects = np.arange(count)

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        place, size = np.array([900.0, -5.0, 0.2 * index]), 0.1 * (index + 1)
        complete = self.corners * [1, 1, index + 2] if self.mark else self.corners
        partial = np.array([[-1, -1, -1], [1, 1, 1]])
        complete, partial = (
            (size * cloud + place).astype(np.float32) for cloud in (complete, partial)
        )
        return Example(complete, partial, None, "thing", str(index), ordered=True)


def test_the_mean_is_in_the_workspaces_of_the_examples():
    """In which all these boxes are one, whatever their size and place."""
    cloud = training_mean(Shapes(40), 1.25, 300)
    assert cloud.shape == (300, 3)
    assert cloud.dtype == np.float32
    corners = Shapes.corners / 1.25
    gaps, nearest = KDTree(corners).query(cloud)
    # The frame is 900 away from the first and smallest box, which is 0.2 wide.
    assert gaps.max() < 900 * np.finfo(np.float32).eps / 0.1
    # Five standard deviations of drawing eight corners at random.
    drawn = np.bincount(nearest, minlength=8)
    assert np.abs(drawn - 300 / 8).max() < 5 * np.sqrt(300 * 7 / 64)


@pytest.mark.parametrize(
    ("count", "num_outputs", "times"),
    [(30, 30, {1}), (30, 12, {0, 1}), (7, 30, {4, 5}), (1, 9, {9})],
)
def test_every_example_gives_as_many_points(count, num_outputs, times):
    """The height tells which example a point is from."""
    cloud = training_mean(Shapes(count, mark=True), 1.0, num_outputs)
    rows = np.rint(np.abs(cloud[:, 2])).astype(int) - 2
    assert len(rows) == num_outputs
    assert set(np.bincount(rows, minlength=count)) == times


def test_the_mean_is_a_function_of_the_seed():
    source = Shapes(20, mark=True)
    first, again, other = (training_mean(source, 1.4, 16, seed) for seed in (3, 3, 4))
    assert first.tobytes() == again.tobytes()
    assert not np.array_equal(first, other)


def test_where_there_is_no_partial_one_is_cropped():
    """Of which the workspace is then: a crop of this line is shorter than it is."""
    line = np.linspace(-1, 1, 41, dtype=np.float32)[:, None] * np.ones(3, np.float32)
    cloud = training_mean(Single(line, None), 1.0, 64)
    assert np.isfinite(cloud).all()
    assert np.abs(cloud).max() > 1.2


def test_without_complete_clouds_there_is_no_mean():
    with pytest.raises(InputError, match="the one: no complete cloud"):
        training_mean(Single(None, PARTIAL[0]), 1.4, 4)
    with pytest.raises(InputError, match="data: no examples"):
        training_mean(Shapes(0), 1.4, 4)
