"""The partial and its mirror image, and the mean of the training shapes."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.baselines.trivial import mirrored, training_mean
from prism_jax.data.source import Example

RNG = np.random.default_rng(0)
PARTIAL = RNG.uniform(-0.7, 0.7, (3, 20, 3)).astype(np.float32)


@pytest.mark.parametrize("num_outputs", [13, 100])
def test_mirrored_is_a_farthest_point_sample_of_both(quick_jit, num_outputs):
    """No point of either is farther from the chosen ones than the next chosen; then
    all are repeated from the first on."""
    both = np.concatenate([PARTIAL, PARTIAL * np.float32([-1, 1, 1])], axis=1)
    sample = quick_jit(mirrored, static_argnums=1)
    made = np.asarray(sample(jnp.asarray(PARTIAL), num_outputs))
    assert made.shape == (3, num_outputs, 3)
    for cloud, points in zip(made, both, strict=True):
        assert KDTree(points).query(cloud)[0].max() == 0
        count = min(num_outputs, 40)
        for n in range(1, count):
            chosen = KDTree(cloud[:n])
            farthest = chosen.query(points)[0].max()
            assert chosen.query(cloud[n])[0] == pytest.approx(farthest, rel=1e-6)
        np.testing.assert_array_equal(cloud, np.resize(cloud[:count], cloud.shape))


class Shapes:
    """Boxes of eight corners, each somewhere else and of another size; their partials
    are two opposite corners. Box i is i + 2 times as high as that."""

    categories = ("thing",)
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(-1, 3)

    def __init__(self, count):
        self.count = count
        self.objects = np.arange(count)

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        place, size = np.array([900.0, -5.0, 0.2 * index]), 0.1 * (index + 1)
        partial = np.array([[-1, -1, -1], [1, 1, 1]])
        complete, partial = (
            (size * cloud + place).astype(np.float32)
            for cloud in (self.corners * [1, 1, index + 2], partial)
        )
        return Example(complete, partial, None, "thing", str(index), ordered=True)


@pytest.mark.parametrize(
    ("count", "num_outputs", "times"),
    [(30, 30, {1}), (30, 12, {0, 1}), (7, 30, {4, 5})],
)
def test_the_mean_is_of_as_many_points_of_every_example(count, num_outputs, times):
    """In the workspaces of their partials, where all these boxes are one, whatever
    their size and place; the height says which example a point is from."""
    cloud = training_mean(Shapes(count), 1.25, num_outputs)
    assert cloud.shape == (num_outputs, 3)
    np.testing.assert_allclose(np.abs(cloud[:, :2]), 1 / 1.25, atol=1e-3)
    rows = np.rint(1.25 * np.abs(cloud[:, 2])).astype(int) - 2
    assert set(np.bincount(rows, minlength=count)) == times
    again, other = (training_mean(Shapes(count), 1.25, num_outputs, s) for s in (0, 1))
    np.testing.assert_array_equal(again, cloud)
    assert not np.array_equal(other, cloud)
