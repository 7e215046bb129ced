"""Which predicted points are added, and how dense they are."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.completion.filtering import (
    MAX_DENSE,
    STRAY,
    densify,
    min_neighbors,
    outlier_mask,
    select,
)
from prism_jax.geometry.cloud import IndexedCloud

EYE = np.array([0.0, 4.0, 0.0])


def grid(count, side=0.5, y=0.0):
    """A square that faces the eye."""
    line = np.linspace(-side, side, count)
    x, z = np.meshgrid(line, line)
    return np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1)


@pytest.fixture(scope="module")
def wall():
    return grid(21, y=0.2)


def test_what_is_new_is_kept(wall):
    behind = grid(11, y=-0.2)
    selection = select(behind, wall, wall, EYE)
    assert selection.kept.all()
    again = select(wall[:50] + 1e-3, wall, wall, EYE)
    assert again.known.all() and not again.kept.any()


def test_nothing_outside_the_workspace_is_kept(wall):
    points = np.concatenate([grid(11, y=-0.9), grid(11, y=-1.01)])
    selection = select(points, wall, wall, EYE)
    np.testing.assert_array_equal(selection.outside, points[:, 1] < -1)
    np.testing.assert_array_equal(selection.kept, ~selection.outside)


@pytest.mark.parametrize("company", [0, 1, 2])
def test_a_point_alone_is_a_stray(wall, company):
    """Two near points, measured or predicted, are company enough."""
    alone = np.array([[0.0, -0.9, 0.0]] * (1 + company))
    alone[:, 0] += np.linspace(0, 0.9 * STRAY, 1 + company)
    selection = select(np.concatenate([grid(5, y=0.0), alone]), wall, wall, EYE)
    np.testing.assert_array_equal(selection.stray[25:], company < 2)
    assert not selection.stray[:25].any()
    assert not (selection.kept & selection.stray).any()


def test_how_much_company_there_has_to_be():
    """It grows with the prediction, and single points never are enough."""
    assert [min_neighbors(n) for n in (64, 2048, 6144, 24_576)] == [2, 4, 12, 48]


@pytest.mark.parametrize("size", [3, 12, 13, 20])
def test_few_together_are_strays(wall, size):
    """Of a prediction of three poses a clump is one up to its own number."""
    rng = np.random.default_rng(0)
    clump = [0.0, -0.9, 0.0] + rng.uniform(-0.1, 0.1, (size, 3)) * STRAY
    surface = grid(78, y=-0.2)
    found = outlier_mask(np.concatenate([surface, clump]), wall)
    assert min_neighbors(len(found)) == 12
    assert not found[: len(surface)].any()
    np.testing.assert_array_equal(found[len(surface) :], size < 13)


def test_measured_points_are_company(wall):
    alone = np.array([[0.0, -0.05, 0.0]])
    far = np.concatenate([grid(78, y=-0.9), alone])
    assert outlier_mask(far, wall[:11])[-1] and not outlier_mask(far, wall)[-1]
    distances = np.sort(np.linalg.norm(wall - alone, axis=1))
    assert not outlier_mask(far, wall, reach=distances[11] + 1e-9)[-1]
    assert outlier_mask(far, wall, reach=distances[11] - 1e-9)[-1]


def test_what_would_hide_the_measured_is_not_kept(wall):
    points = np.concatenate([grid(5, 0.3, y=0.6), grid(5, 0.3, y=-0.6)])
    selection = select(points, wall, wall, EYE)
    np.testing.assert_array_equal(selection.in_front, points[:, 1] > 0)
    np.testing.assert_array_equal(selection.kept, points[:, 1] < 0)
    # Beside the wall it hides nothing, and nobody knows without a sensor.
    beside = points[:25] + [1.2, 0, 0]
    assert not select(beside, wall, wall, EYE).in_front.any()
    assert select(points, wall, wall, None).kept.all()


def test_where_the_sensor_looked_through_counts_if_nothing_else_is_there(wall):
    """The wall ends at 0.5; lines of sight diverge."""
    far = grid(11, side=0.9, y=-0.2)
    beside = np.abs(far[:, [0, 2]]).max(axis=1) > 0.5 * 4.2 / 3.8 + 0.3
    within = np.abs(far[:, [0, 2]]).max(axis=1) <= 0.5
    selection = select(far, wall, wall, EYE, "empty")
    assert beside.sum() == 40 and selection.looked_through[beside].all()
    assert not selection.looked_through[within].any()
    np.testing.assert_array_equal(selection.kept, ~selection.looked_through)
    for known in (select(far, wall, wall, EYE), select(far, wall, wall, None, "empty")):
        assert not known.looked_through.any() and known.kept.all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points(wall, count):
    selection = select(grid(2, y=-0.2)[:count], wall, wall, EYE)
    assert all(which.shape == (count,) for which in selection)
    one = select(grid(3, y=-0.2), wall[:1], wall[:1], EYE)
    assert not one.kept.any()  # no spacing, so nothing is far enough to be new


def test_neither_scale_of_the_view_nor_order_matters(wall):
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    order = np.random.default_rng(1).permutation(300)
    here, there = (
        select(points, wall, wall, EYE),
        select(points[order], wall, wall, EYE),
    )
    for a, b in zip(here, there, strict=True):
        np.testing.assert_array_equal(a[order], b)


@pytest.mark.parametrize("times", [2.0, 10.0, 60.0])
def test_denser_points_lie_between(times):
    sparse = grid(20)
    dense = densify(sparse, times)
    np.testing.assert_array_equal(dense[: len(sparse)], sparse)
    assert len(dense) == times * len(sparse)
    assert np.abs(dense[:, 1]).max() == 0 and np.abs(dense).max() <= 0.5
    # As even as it is dense: no far place is left without, none is crowded.
    gaps = KDTree(dense).query(grid(90))[0]
    assert gaps.max() < 4 / np.sqrt(IndexedCloud(dense).density)
    assert (
        0.6 < IndexedCloud(dense).density / IndexedCloud(sparse).density / times < 1.7
    )


def test_gaps_stay_gaps():
    far = np.concatenate([grid(10), grid(10) + [5.0, 0, 0]])
    dense = densify(far, 20.0)
    assert not ((dense[:, 0] > 0.5) & (dense[:, 0] < 4.5)).any()


@pytest.mark.parametrize("times", [0.0, 0.2, 1.0])
def test_none_are_left_out(times):
    np.testing.assert_array_equal(densify(grid(10), times), grid(10))


def test_it_ends():
    assert len(densify(grid(30), np.inf)) == MAX_DENSE
    for points in (np.zeros((0, 3)), np.ones((1, 3)), np.ones((9, 3))):
        np.testing.assert_array_equal(densify(points, 10.0), points)
    line = np.linspace(0, 1, 12)[:, None] * [1.0, 0, 0]
    assert len(densify(line, 4.0)) == 48


def test_density_is_that_of_the_surface():
    rng = np.random.default_rng(0)
    plane = rng.uniform(0, 1, (20_000, 3)) * [1, 1, 0]
    np.testing.assert_allclose(IndexedCloud(plane).density, 20_000, rtol=0.05)
    np.testing.assert_allclose(IndexedCloud(3 * plane).density, 20_000 / 9, rtol=0.05)
    # Lines, as a LiDAR scans: neighbours along one say nothing of the next.
    lines = np.stack(np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 1, 50)), -1)
    lines = np.pad(lines.reshape(-1, 2), ((0, 0), (0, 1)))
    assert 0.2 < IndexedCloud(lines).density / 20_000 < 5
    assert IndexedCloud(plane[:8]).density == 0
    assert IndexedCloud(plane[:1]).spacing == np.inf
