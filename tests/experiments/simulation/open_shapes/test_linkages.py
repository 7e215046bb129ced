import numpy as np
import pytest

from experiments.simulation.open_shapes.attachments import extent
from experiments.simulation.open_shapes.linkages import linkage

SIZE = np.array([0.8, 0.5, 1.0])


def test_linkages_hold_together_and_fill_their_box_along_one_side():
    for seed in range(12):
        solid = linkage(np.random.default_rng(seed), SIZE)
        assert sum(part.volume() > 1e-7 for part in solid.decompose()) == 1
        middle, sides = extent(solid)
        np.testing.assert_allclose(middle, 0, atol=1e-9)
        assert np.max(sides / SIZE) == pytest.approx(1)


def test_postures_and_links_differ():
    solids = [linkage(np.random.default_rng(seed), SIZE) for seed in range(8)]
    shares = [solid.volume() / np.prod(extent(solid)[1]) for solid in solids]
    assert max(shares) > 3 * min(shares)
