"""Partial clouds cut from complete ones."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from prism_jax.data.crops import CROP_SHARES, CROP_VIEWPOINTS, crop


@pytest.mark.parametrize("share", [*CROP_SHARES.values(), 0.0, 0.43218])
def test_crop_removes_exactly_the_nearest_share(share):
    complete = np.random.default_rng(0).uniform(-1, 1, (400, 3))
    for viewpoint in CROP_VIEWPOINTS:
        farthest = np.argsort(cdist(complete, viewpoint[None])[:, 0])[
            int(share * 400) :
        ]
        expected = complete[np.sort(farthest)]
        np.testing.assert_array_equal(crop(complete, viewpoint, share), expected)
    # Ties keep the count.
    same = np.zeros((100, 3), np.float32)
    assert len(crop(same, viewpoint, share)) == 100 - int(share * 100)


@pytest.mark.parametrize("share", [1.0, -0.1, np.nan])
def test_a_share_out_of_range_is_refused(share):
    with pytest.raises(ValueError, match="share"):
        crop(np.zeros((10, 3)), CROP_VIEWPOINTS[0], share)
