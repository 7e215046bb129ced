"""Augmentation: crops, thinning and noise of partial clouds."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from prism_jax.data.augmentation import Augmentation, augmented
from prism_jax.data.source import Example
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import SURFACE, UNKNOWN, Visibility


@pytest.fixture(scope="module")
def example() -> Example:
    """400 points, each in a pixel of its own, in the order of the pixels."""
    eye = np.array([0.0, 0, -3], np.float32)
    camera = Camera(
        rotation=np.eye(3, dtype=np.float32),
        translation=-eye,
        intrinsics=np.array([(20, 0, 9.5), (0, 20, 9.5), (0, 0, 1)], np.float32),
        height=20,
        width=20,
    )
    rows, columns = np.indices((20, 20)).reshape(2, -1)
    depth = np.random.default_rng(1).uniform(2, 4, 400)
    rays = np.stack([columns - 9.5, rows - 9.5, np.full(400, 20.0)], -1) / 20
    points = (eye + rays * depth[:, None]).astype(np.float32)
    state = np.full((20, 20), SURFACE, np.uint8)
    known = Visibility(camera, state, depth.reshape(20, 20).astype(np.float32))
    return Example(points, points, eye, "", "0", ordered=True, visibility=known)


def subset(few: np.ndarray, many: np.ndarray) -> np.ndarray:
    """Places of the few among the many, which must increase."""
    gaps, places = KDTree(many).query(few)
    np.testing.assert_array_equal(gaps, 0)
    assert np.all(np.diff(places) > 0)
    return places


def test_a_crop_takes_a_half_space_and_its_surface_is_forgotten(example):
    settings = Augmentation(crop=1.0, crop_shares=(0.2, 0.5))
    before = example.partial.copy(), example.visibility.state.copy()
    shares = []
    for seed in range(40):
        found = augmented(example, settings, np.random.default_rng(seed))
        kept = np.zeros(400, bool)
        kept[subset(found.partial, example.partial)] = True
        shares.append(1 - kept.mean())
        state, depth = found.visibility.state.ravel(), found.visibility.depth.ravel()
        # The point that decides the plane may fall on either side of it.
        assert np.sum((state == SURFACE) != kept) <= 1
        assert np.all((depth > 0) == (state != UNKNOWN))
        again = augmented(example, settings, np.random.default_rng(seed))
        np.testing.assert_array_equal(again.partial, found.partial)
    assert 0.19 < min(shares) < 0.25 and 0.45 < max(shares) < 0.51
    np.testing.assert_array_equal(example.partial, before[0])
    np.testing.assert_array_equal(example.visibility.state, before[1])


def test_thinning_leaves_any_number_down_to_the_fewest_in_their_order(example):
    counts = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        found = augmented(example, Augmentation(thin=0.5, fewest=50), rng)
        counts.append(len(subset(found.partial, example.partial)))
    whole = np.array(counts) == 400
    assert 0.3 < whole.mean() < 0.7
    assert 50 <= min(counts) < 80
    assert np.median(np.array(counts)[~whole]) < 0.6 * 400


def test_jitter_is_in_sides_of_the_partial(example):
    far = example._replace(partial=example.partial * 100)
    for given, unit in ((example, 1.0), (far, 100.0)):
        deviations = []
        for seed in range(30):
            rng = np.random.default_rng(seed)
            found = augmented(given, Augmentation(jitter=0.02), rng)
            deviations.append(np.std(found.partial - given.partial) / unit)
        side = np.ptp(example.partial, axis=0).max()
        assert max(deviations) == pytest.approx(0.02 * side, rel=0.1)
        assert min(deviations) < 0.005 * side
