"""Clouds with a tree, against all pairs and closed forms."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from prism_jax.geometry.cloud import MAX_SIGHTS, IndexedCloud

RNG = np.random.default_rng(0)


def test_distances_are_those_of_all_pairs():
    points, asked = RNG.normal(size=(50, 3)), RNG.normal(size=(20, 3))
    pairs = np.sort(cdist(asked, points), axis=1)
    cloud = IndexedCloud(points)
    for k in (1, 8, 50):
        np.testing.assert_allclose(cloud.distance(asked, k), pairs[:, k - 1])
    np.testing.assert_allclose(cloud.distance(asked, 99), pairs[:, -1])


def test_copies_change_neither_spacing_nor_density():
    points = RNG.normal(size=(50, 3))
    own, twice = IndexedCloud(points), IndexedCloud(np.concatenate([points, points]))
    assert len(twice.distinct) == 50
    assert own.distinct.tree is own.tree
    np.testing.assert_array_equal(twice.distinct.points, np.unique(points, axis=0))
    others = np.sort(cdist(points, points), axis=1)
    for cloud in (own, twice):
        assert cloud.spacing == pytest.approx(np.median(others[:, 1]))
        assert cloud.density == pytest.approx(8 / np.pi / np.median(others[:, 8]) ** 2)


@pytest.mark.parametrize("count", [0, 1])
def test_of_too_few_points(count):
    cloud = IndexedCloud(np.zeros((count, 3)))
    assert cloud.spacing == np.inf
    assert cloud.density == 0.0


def test_lines_of_sight():
    eye = np.array([1.0, 2.0, 3.0])
    points = RNG.normal(size=(MAX_SIGHTS + 1, 3))
    cloud = IndexedCloud(points)
    sights = cloud.sights(eye)
    assert cloud.sights(eye.copy()) is sights
    directions = np.asarray(sights[0].data)
    np.testing.assert_allclose(eye + directions * sights[1][:, None], points[::2])


def test_of_very_many_points_some_are_taken_and_the_density_is_that_of_all():
    points = np.random.default_rng(0).uniform(size=(8000, 3)) * [1, 1, 0]
    whole = IndexedCloud.of_enough(points)
    some = IndexedCloud.of_enough(points, 2000)
    assert len(whole) == 8000 and len(some) == 2000
    np.testing.assert_allclose(some.density, whole.density, rtol=0.1)
