import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from scipy.spatial.distance import cdist

from prism_jax.envelope.distance import KINDS, Envelope, Surfaces
from prism_jax.envelope.voxels import FREE, UNSEEN, Grid
from prism_jax.io.errors import InputError

RNG = np.random.default_rng(0)


def envelope(state, lower=(0.0, 0.0, 0.0), voxel=0.1, points=None, margin=0.0):
    state = np.asarray(state, np.uint8)
    lower = np.asarray(lower, float)
    grid = Grid.over(lower, lower + voxel * np.array(state.shape), voxel)
    assert grid.shape == state.shape
    return Envelope(grid, state, Surfaces(points or {}), margin)


def scattered(shape=(12, 10, 11), taken=0.03):
    return np.where(RNG.random(shape) < taken, UNSEEN, FREE)


def test_at_voxels_middles_it_is_the_distance_transform_less_half_a_voxel():
    """Scipy's transform measures to middles; along an axis a face is half a voxel
    nearer, and never by more than half a diagonal."""
    state = scattered()
    one = envelope(state)
    found = one.query(one.grid.centers()).not_free.reshape(state.shape)
    outside = np.pad(state == FREE, 1)
    middles = 0.1 * distance_transform_edt(outside)[1:-1, 1:-1, 1:-1]
    assert (found[state != FREE] == 0).all()
    assert (found <= middles + 1e-12).all()
    assert (found >= middles - one.grid.half_diagonal - 1e-12).all()
    slab = np.full((20, 3, 3), FREE)
    slab[0] = UNSEEN
    tall = envelope(np.repeat(np.repeat(slab, 15, 1), 15, 2))
    middle = np.array([[0.1 * k + 0.05, 2.25, 2.25] for k in range(1, 10)])
    expected = 0.1 * np.arange(1, 10) - 0.1 + 0.05
    np.testing.assert_allclose(tall.query(middle).not_free, expected, atol=1e-12)


@pytest.mark.parametrize("shape", [(12, 10, 11), (1, 1, 1), (3, 1, 20)])
@pytest.mark.parametrize("taken", [0.0, 0.01, 0.5, 1.0])
def test_the_field_is_the_query_at_every_middle(shape, taken):
    one = envelope(scattered(shape, taken))
    found = one.query(one.grid.centers()).not_free.reshape(shape)
    np.testing.assert_allclose(one.not_free_field, found, atol=1e-12)


def test_anywhere_it_is_the_distance_to_the_nearest_box():
    state = scattered(taken=0.01)
    one = envelope(state, lower=(5.0, -3.0, 2.0))
    points = RNG.uniform(one.grid.lower, one.grid.upper, (300, 3))
    padded = np.pad(state != FREE, 1, constant_values=True)
    corners = one.grid.lower + 0.1 * (np.argwhere(padded) - 1)
    nearest = np.full(len(points), np.inf)
    for corner in corners:
        gap = np.maximum(np.maximum(corner - points, points - corner - 0.1), 0)
        nearest = np.minimum(nearest, np.linalg.norm(gap, axis=1))
    found = one.query(points).not_free
    np.testing.assert_allclose(found, nearest, atol=1e-12)


def test_outside_of_the_grid_nothing_is_known_to_be_free():
    one = envelope(np.full((4, 4, 4), FREE))
    found = one.query(np.array([[-0.1, 0.2, 0.2], [9, 9, 9.0], [0.2, 0.2, 0.2]]))
    assert found.not_free[:2].tolist() == [0, 0]
    assert found.not_free[2] == pytest.approx(0.2)
    assert one.query(np.zeros((0, 3))).not_free.shape == (0,)
    with pytest.raises(InputError, match="not finite"):
        one.query(np.array([[0, 0, np.nan]]))


def test_where_everything_is_unseen_the_distance_is_zero():
    one = envelope(np.full((4, 4, 4), UNSEEN))
    found = one.query(RNG.uniform(0, 0.4, (20, 3)))
    assert (found.not_free == 0).all()
    assert np.isinf(found.surface).all() and (found.kind == -1).all()
    volumes = one.volumes()
    assert volumes["not_free"] == pytest.approx(0.4**3)
    assert volumes["envelope"] == volumes["free"] == 0


def test_surfaces_of_each_kind_are_told_apart():
    clouds = {kind: RNG.uniform(0, 1, (40, 3)) for kind in KINDS}
    points = RNG.uniform(-1, 2, (200, 3))
    found, kind = Surfaces(clouds).distance(points, 0.25)
    apart = np.stack([cdist(points, clouds[name]).min(axis=1) for name in KINDS])
    np.testing.assert_allclose(found, apart.min(axis=0) - 0.25)
    np.testing.assert_array_equal(kind, apart.argmin(axis=0))
    assert (found < 0).any()


@pytest.mark.parametrize(
    ("points", "told"),
    [
        ({"people": np.zeros((1, 3))}, "unknown kind"),
        ({"robot": np.full((1, 3), np.nan)}, "not finite"),
    ],
)
def test_surfaces_that_are_none_are_refused(points, told):
    with pytest.raises(InputError, match=told):
        Surfaces(points)


@pytest.mark.parametrize("origin", [np.zeros(3), np.array([4e5, -5e6, 100.0])])
def test_the_volume_around_a_point_is_a_balls(origin):
    margin, voxel = 0.5, 0.05
    state = np.full((30, 30, 30), UNSEEN)
    at = origin + 0.75
    one = envelope(state, origin, voxel, {"measured": at[None]}, margin)
    inner, outer = (
        4 / 3 * np.pi * (margin + more) ** 3
        for more in (0.0, 2 * one.grid.half_diagonal)
    )
    assert inner < one.volumes()["envelope"] < outer
    # What is free is none of it, however near.
    state = state.copy()
    state[:15] = FREE
    half = envelope(state, origin, voxel, {"measured": at[None]}, margin)
    assert half.taken.sum() == one.taken[15:].sum()
