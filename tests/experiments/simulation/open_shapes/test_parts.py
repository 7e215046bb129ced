"""Primitives and structures: what each draws in its box."""

import numpy as np
import pytest

from experiments.simulation.open_shapes.attachments import extent
from experiments.simulation.open_shapes.compositions import STRUCTURES
from experiments.simulation.open_shapes.frames import tub, vase
from experiments.simulation.open_shapes.primitives import (
    PRIMITIVES,
)
from experiments.simulation.solids import as_mesh

SIZE = np.array([0.5, 0.7, 0.9])


@pytest.mark.parametrize("number", range(len(PRIMITIVES)))
def test_primitives_are_closed_and_in_one_piece_within_their_box(number):
    for seed in range(2):
        solid = PRIMITIVES[number](np.random.default_rng(seed), SIZE)
        assert solid.volume() > 0
        assert as_mesh(solid).is_watertight
        assert len(solid.decompose()) == 1
        middle, sides = extent(solid)
        assert np.all(np.abs(middle) + sides / 2 <= SIZE / 2 + 0.08)


@pytest.mark.parametrize("number", range(len(STRUCTURES)))
def test_structures_are_closed_and_within_their_box(number):
    for seed in range(2):
        solid = STRUCTURES[number](np.random.default_rng(seed), SIZE)
        assert solid.volume() > 0
        assert as_mesh(solid).is_watertight
        middle, sides = extent(solid)
        assert np.all(np.abs(middle) + sides / 2 <= SIZE / 2 + 0.08)


@pytest.mark.parametrize("make", [tub, vase])
def test_shells_are_hollow_and_open(make):
    """Less than their hull, and no cavity: one surface, of a ball's kind."""
    for seed in range(2):
        solid = make(np.random.default_rng(seed), SIZE)
        assert solid.volume() < 0.75 * solid.hull().volume()
        assert all(part.volume() > 0 for part in solid.decompose())
        top = extent(solid)[1][2] / 2 - 1e-3
        assert not solid.ray_cast((0, 0, top), (0, 0, 0))
