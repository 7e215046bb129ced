"""What counts as a stray, and what never does."""

import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.preprocessing.outliers import OUTLIER_SIDES, TAIL, far_outliers


def blob(count=948, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [0.5, 0.3, 0.2]


def test_a_few_points_far_away_are_strays():
    for place in [(300, 0, 0), (0, -300, 0), (5, 5, 5), (0, 0, -4.5)]:
        for number in (1, 9):
            points = np.concatenate(
                [blob(), np.tile(place, (number, 1)) + blob(number)]
            )
            strays = np.arange(len(points)) >= 948
            assert np.array_equal(far_outliers(points), strays)
            # In any unit, and about any origin.
            assert np.array_equal(far_outliers(1e-3 * points + 1e4), strays)


def test_how_far_is_too_far():
    """In longest sides of the box of the rest, from that box."""
    line = np.zeros((1001, 3))
    line[:, 1] = np.linspace(0, 1, 1001)
    box = line[10:-10, 1]
    side = box[-1] - box[0]
    for share, expected in [(0.99, False), (1.01, True)]:
        line[-1, 2] = share * OUTLIER_SIDES * side
        assert far_outliers(line)[-1] == expected
    line[-1] = [0, box[-1] + 0.99 * OUTLIER_SIDES * side, 0]
    assert not far_outliers(line).any()


def test_small_clouds_and_one_place_have_none():
    for count in (1, TAIL - 1):
        points = blob(count)
        points[0] = 300
        assert not far_outliers(points).any()
    points = np.ones((500, 3))
    points[:3] = blob(3)
    assert not far_outliers(points).any()


def test_jit_and_vmap_agree_with_numpy():
    clouds = np.stack([blob(400, seed) for seed in range(3)]).astype(np.float32)
    clouds[1, 7] = 100
    clouds[2, [3, 5]] = -50
    expected = np.stack([far_outliers(cloud) for cloud in clouds])
    found = jax.jit(jax.vmap(far_outliers))(jnp.asarray(clouds))
    assert np.array_equal(found, expected)
    assert expected.sum() == 3
