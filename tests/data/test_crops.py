"""Partial clouds cut from complete ones."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from prism_jax.data.crops import CROP_SHARES, CROP_VIEWPOINTS, crop


@pytest.fixture(scope="module")
def complete() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (4000, 3))


@pytest.mark.parametrize("share", [*CROP_SHARES.values(), 0.0, 0.43218])
def test_crop_removes_exactly_the_nearest_share(complete, share):
    for viewpoint in CROP_VIEWPOINTS:
        partial = crop(complete, viewpoint, share)
        gaps = cdist(complete, viewpoint[None])[:, 0]
        farthest = np.argsort(gaps)[int(share * 4000) :]
        np.testing.assert_array_equal(partial, complete[np.sort(farthest)])


def test_crop_viewpoints_are_the_corners_and_ties_keep_the_count():
    assert {tuple(np.sign(corner)) for corner in CROP_VIEWPOINTS} == {
        (x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)
    }
    np.testing.assert_array_equal(np.abs(CROP_VIEWPOINTS), 1)
    same = np.zeros((10, 3), np.float32)
    assert len(crop(same, CROP_VIEWPOINTS[0], 0.25)) == 8
    assert crop(same, CROP_VIEWPOINTS[0], 0.25).dtype == np.float32
    for share in (1.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="share"):
            crop(same, CROP_VIEWPOINTS[0], share)
