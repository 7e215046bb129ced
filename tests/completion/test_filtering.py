"""Which predicted points are added, and how dense they are."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.completion import filtering
from prism_jax.completion.filtering import (
    STRAY,
    added_points,
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
    """Farther from what was measured than half the spacing of what was read."""
    assert select(grid(11, y=-0.2), wall, wall, EYE).kept.all()
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    selection = select(points, wall, np.concatenate([wall, wall[:40]]), EYE)
    apart = KDTree(wall).query(points)[0]
    np.testing.assert_array_equal(selection.known, apart <= 0.5 * 0.05)
    assert 0 < selection.known.sum() < 100
    assert not (selection.known & selection.kept).any()


def test_nothing_outside_the_workspace_is_kept(wall):
    points = np.concatenate([grid(11, y=-0.9), grid(11, y=-1.01)])
    selection = select(points, wall, wall, EYE)
    np.testing.assert_array_equal(selection.outside, points[:, 1] < -1)
    np.testing.assert_array_equal(selection.kept, ~selection.outside)


@pytest.mark.parametrize(("surface", "company"), [(78, 12), (5, 2)])
@pytest.mark.parametrize("more", [0, 1])
def test_few_together_are_strays(wall, surface, company, more):
    """How many it takes grows with the prediction."""
    rng = np.random.default_rng(0)
    clump = [0.0, -0.9, 0.0] + rng.uniform(-0.1, 0.1, (company + more, 3)) * STRAY
    points = np.concatenate([grid(surface, y=-0.2), clump])
    assert min_neighbors(len(points)) == company
    selection = select(points, wall, wall, EYE)
    assert not selection.stray[: surface**2].any()
    np.testing.assert_array_equal(selection.stray[surface**2 :], more == 0)
    assert not (selection.kept & selection.stray).any()


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
    for eye, background in ((EYE, "unknown"), (None, "empty")):
        assert select(far, wall, wall, eye, background).kept.all()


def test_few_points(wall):
    for count in (0, 1, 2):
        selection = select(grid(2, y=-0.2)[:count], wall, wall, EYE)
        assert all(which.shape == (count,) for which in selection)
    one = select(grid(3, y=-0.2), wall[:1], wall[:1], EYE)
    assert not one.kept.any()  # no spacing, so nothing is far enough to be new


@pytest.mark.parametrize("times", [2.0, 10.0])
def test_denser_points_lie_between(times):
    sparse = grid(20)
    dense = densify(sparse, times)
    np.testing.assert_array_equal(dense[: len(sparse)], sparse)
    assert len(dense) == times * len(sparse)
    assert np.abs(dense[:, 1]).max() == 0 and np.abs(dense).max() <= 0.5
    # As even as it is dense: no far place is left without, none is crowded.
    density = IndexedCloud(dense).density
    assert KDTree(dense).query(grid(90))[0].max() < 4 / np.sqrt(density)
    assert 0.6 < density / IndexedCloud(sparse).density / times < 1.7
    # Gaps stay gaps.
    apart = densify(np.concatenate([sparse, sparse + [5.0, 0, 0]]), times)
    assert not ((apart[:, 0] > 0.5) & (apart[:, 0] < 4.5)).any()


def test_as_many_times_as_dense_as_the_measured(wall):
    behind = grid(8, y=-0.2)
    for density in (0.0, 2.0):
        added, *_, selection = added_points(behind, wall, wall, EYE, density)
        np.testing.assert_array_equal(added[:64], behind[selection.kept])
        given = IndexedCloud(wall if density else behind).density
        assert 0.6 < IndexedCloud(added).density / given / (density or 1.0) < 1.7


def test_none_are_left_out_and_it_ends(monkeypatch):
    monkeypatch.setattr(filtering, "MAX_DENSE", 3000)
    for times in (0.0, 0.2, 1.0):
        np.testing.assert_array_equal(densify(grid(10), times), grid(10))
    assert len(densify(grid(30), np.inf)) == 3000
    for points in (np.zeros((0, 3)), np.ones((1, 3)), np.ones((9, 3))):
        np.testing.assert_array_equal(densify(points, 10.0), points)
    line = np.linspace(0, 1, 12)[:, None] * [1.0, 0, 0]
    assert len(densify(line, 4.0)) == 48


def test_density_is_that_of_the_surface():
    rng = np.random.default_rng(0)
    plane = rng.uniform(0, 1, (20_000, 3)) * [1, 1, 0]
    np.testing.assert_allclose(IndexedCloud(3 * plane).density, 20_000 / 9, rtol=0.05)
    # Lines, as a LiDAR scans: neighbours along one say nothing of the next.
    lines = np.stack(np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 1, 50)), -1)
    lines = np.pad(lines.reshape(-1, 2), ((0, 0), (0, 1)))
    assert 0.2 < IndexedCloud(lines).density / 20_000 < 5
