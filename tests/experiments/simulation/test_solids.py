"""Solids whose volumes have closed forms."""

import numpy as np
import pytest
from manifold3d import Manifold

from experiments.simulation.solids import (
    as_mesh,
    assembled,
    box,
    front_profile,
    side_profile,
    slab,
    sweep,
    torus,
)


def bounds(solid: Manifold) -> np.ndarray:
    return np.array(solid.bounding_box()).reshape(2, 3)


def test_a_torus_and_a_swept_circle_have_the_volume_of_pappus():
    """Area times the way of its middle, in a circle of any plane."""
    ring = torus(1.0, 0.25, segments=200, around=200)
    assert ring.volume() == pytest.approx(2 * np.pi**2 * 0.25**2, rel=1e-3)
    angle = np.linspace(0, 1.5 * np.pi, 300)
    around = 2 * np.pi * np.arange(100) / 100
    section = 0.2 * np.stack([np.cos(around), np.sin(around)], axis=1)
    path = np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    for turn in range(3):
        solid = sweep(np.roll(path, turn, axis=1), section)
        assert solid.volume() == pytest.approx(np.pi * 0.04 * 1.5 * np.pi, rel=2e-3)
        assert solid.genus() == 0


@pytest.mark.parametrize(("profile", "axis"), [(front_profile, 1), (side_profile, 0)])
def test_profiles_are_extruded_about_the_middle(profile, axis):
    outline = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0)])
    solid = profile(outline, 0.5)
    assert solid.volume() == pytest.approx(0.5)
    lower, upper = bounds(solid)
    assert (lower[axis], upper[axis]) == pytest.approx((-0.25, 0.25))
    assert (lower[1 - axis], upper[1 - axis]) == pytest.approx((0, 2))
    assert (lower[2], upper[2]) == pytest.approx((0, 1))


def test_assembly_stands_on_the_floor_without_voids_and_splinters():
    shell = box((0, 0, 5), (2, 2, 2)) - box((0, 0, 5), (1, 1, 1))
    splinter = box((3, 0, 6), (1e-3, 1e-3, 1e-3))
    (whole,) = assembled([shell, splinter])
    assert whole.volume() == pytest.approx(8)
    np.testing.assert_allclose(bounds(whole), [(-1, -1, 0), (1, 1, 2)], atol=1e-9)


def test_a_slab_is_what_lies_between_its_grids():
    u, v = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 2, 30), indexing="ij")
    upper = np.stack([u, v, 1 + u * v**2], axis=-1)
    solid = slab(upper, np.stack([u, v, 0 * u], axis=-1))
    assert solid.volume() == pytest.approx(2 + 8 / 6, rel=2e-3)  # the integral
    assert as_mesh(solid).is_watertight
    np.testing.assert_allclose(bounds(solid), [(0, 0, 0), (1, 2, 5)])
