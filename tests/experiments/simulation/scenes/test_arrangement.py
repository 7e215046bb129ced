"""Things set down beside each other, and what they stand on."""

import numpy as np
import pytest

from experiments.simulation.scenes.arrangement import (
    separation,
)

SQUARE = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])


@pytest.mark.parametrize(
    ("shift", "apart"), [((2.0, 0), 1), ((0.5, 3), 2), ((0.75, 0.5), -0.25)]
)
def test_polygons_are_apart_or_overlap(shift, apart):
    assert separation(SQUARE, SQUARE + shift) == pytest.approx(apart)
    assert separation(SQUARE + shift, SQUARE) == pytest.approx(apart)
