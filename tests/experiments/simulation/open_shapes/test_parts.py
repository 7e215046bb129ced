"""Primitives and structures: what each draws in its box."""

import numpy as np
import pytest
from manifold3d import Manifold

from experiments.simulation.open_shapes.attachments import extent
from experiments.simulation.open_shapes.primitives import (
    PRIMITIVES,
    any_axis,
    fitted,
    frustum,
    pipe_along,
)
from experiments.simulation.open_shapes.shells import tub, vase
from experiments.simulation.open_shapes.structures import STRUCTURES, grid
from experiments.simulation.solids import as_mesh, box

SIZE = np.array([0.5, 0.7, 0.9])


@pytest.mark.parametrize("number", range(len(PRIMITIVES)))
def test_primitives_are_closed_and_in_one_piece_within_their_box(number):
    for seed in range(6):
        solid = PRIMITIVES[number](np.random.default_rng(seed), SIZE)
        assert solid.volume() > 0
        assert as_mesh(solid).is_watertight
        assert len(solid.decompose()) == 1
        middle, sides = extent(solid)
        assert np.all(np.abs(middle) + sides / 2 <= SIZE / 2 + 0.08)


@pytest.mark.parametrize("number", range(len(STRUCTURES)))
def test_structures_are_closed_and_within_their_box(number):
    for seed in range(4):
        solid = STRUCTURES[number](np.random.default_rng(seed), SIZE)
        assert solid.volume() > 0
        assert as_mesh(solid).is_watertight
        middle, sides = extent(solid)
        assert np.all(np.abs(middle) + sides / 2 <= SIZE / 2 + 0.08)


@pytest.mark.parametrize("make", [tub, vase])
def test_shells_are_hollow_and_open(make):
    """Less than their hull, and no cavity: one surface, of a ball's kind."""
    for seed in range(5):
        solid = make(np.random.default_rng(seed), SIZE)
        assert solid.volume() < 0.75 * solid.hull().volume()
        assert all(part.volume() > 0 for part in solid.decompose())
        top = extent(solid)[1][2] / 2 - 1e-3
        assert not solid.ray_cast((0, 0, top), (0, 0, 0))


def test_fitted_solids_fill_the_box():
    solid = fitted(box((3, 2, 1), (1, 2, 3)).rotate((30, 0, 0)), SIZE)
    middle, sides = extent(solid)
    np.testing.assert_allclose(middle, 0, atol=1e-9)
    np.testing.assert_allclose(sides, SIZE)


def test_any_axis_turns_what_is_built_into_the_box():
    """A cone's narrow end looks along z, x or y, and its box is the same."""
    seen = set()

    def cone(rng, size):
        return fitted(Manifold.cylinder(1, 1, 0.1), size)

    for seed in range(12):
        solid = any_axis(cone)(np.random.default_rng(seed), SIZE)
        np.testing.assert_allclose(extent(solid)[1], SIZE, rtol=1e-6)
        ends = [solid.trim_by_plane(axis, 0.25 * SIZE @ axis) for axis in np.eye(3)]
        seen.add(int(np.argmin([end.volume() for end in ends])))
    assert seen == {0, 1, 2}


def test_a_pipe_has_its_radius_where_the_way_is_straight():
    solid = pipe_along(np.linspace((0, 0, 0), (0, 0, 2), 3), 0.1, 200)
    assert solid.volume() == pytest.approx(2 * np.pi * 0.1**2, rel=1e-3)


def test_a_grid_is_one_part_again_and_again_on_a_plate():
    """Cut below its top, it comes apart into so many pieces."""
    counts = set()
    for seed in range(20):
        whole = grid(np.random.default_rng(seed), SIZE, frustum, 4)
        assert len(whole.decompose()) == 1
        top = whole.bounding_box()[5] - 1e-3
        parts = whole.trim_by_plane((0, 0, 1), top).decompose()
        assert np.ptp([part.volume() for part in parts]) < 1e-9
        counts.add(len(parts))
    assert counts == {2, 3, 4}
