"""What was measured around an object: closed forms, other frames, degenerate scans."""

import jax
import numpy as np

from prism_jax.completion.filtering import select
from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.geometry.visibility import (
    BACKGROUND,
    MAP_SIZE,
    NEARER,
    SURFACE,
    UNKNOWN,
    seen_by,
)
from prism_jax.geometry.workspace import Workspace
from prism_jax.preprocessing.visibility import PAST
from prism_jax.preprocessing.visibility_map import (
    box_exit,
    in_free_space,
    seen_among,
)

EYE = np.array([0.0, -5.0, 0.0])
CUBE = Workspace(np.zeros(3), np.array(0.7))


def plane(y, x, z, step):
    """A grid in a plane of constant y, from bound to bound in x and z."""
    across, up = (
        np.linspace(low, high, round((high - low) / step) + 1) for low, high in (x, z)
    )
    x, z = (axis.ravel() for axis in np.meshgrid(across, up))
    return np.stack([x, np.full(x.shape, float(y)), z], axis=1)


PLATE = plane(0, (-0.5, 0.5), (-0.5, 0.5), 0.01)
POST = plane(-2.5, (0.29, 0.5), (-0.5, 0.5), 0.004)
WALL = plane(3, (-2, 0.8), (-2, 0.96), 0.016)
FLOOR = np.concatenate([plane(y, (-1, 1), (-0.6, -0.58), 0.01) for y in (0.3, 0.31)])
AROUND = np.concatenate([POST, WALL, FLOOR])
"""On the map, which spans 0.7 to each side at the plate's depth of five: a post halfway
to the right of 0.58, a wall at depth eight elsewhere below 0.6, and a strip of
something 0.3 behind the plate and 0.55 below its middle."""


def middles():
    """Where the rays of the pixels cross the plate's plane: x and z."""
    step = (np.arange(MAP_SIZE) - 31.5) * 2 * 0.7 / MAP_SIZE
    return np.meshgrid(step, -step)


def expected():
    """States and depths, and which pixels are no border of anything."""
    x, z = middles()
    state, depth = np.full(x.shape, UNKNOWN), np.zeros(x.shape)
    sure = np.ones(x.shape, bool)
    for kind, away, where, edges in (
        (BACKGROUND, 8, (x < 0.5) & (z < 0.6), (0 * x + 9, z - 0.6)),
        (NEARER, 5.3, np.abs(z + 0.59 / 1.06) < 0.009, (x * 0 + 9, z + 0.5566)),
        (NEARER, 2.5, x > 0.58, (x - 0.58, x * 0 + 9)),
        (SURFACE, 5, np.maximum(abs(x), abs(z)) < 0.5, (abs(x) - 0.5, abs(z) - 0.5)),
    ):
        state[where], depth[where] = kind, away
        sure &= (np.abs(edges) > 0.03).all(axis=0)
    return state, depth, sure & ~((x > 0.47) & (x < 0.61))


def test_a_scene_in_closed_form():
    known = seen_among(PLATE, AROUND, EYE, CUBE)
    state, depth, sure = expected()
    assert sure.mean() > 0.6 and set(state[sure]) == {0, 1, 2, 3}
    np.testing.assert_array_equal(known.state[sure], state[sure])
    np.testing.assert_allclose(known.depth[sure], depth[sure], atol=1e-5)
    x, z = middles()
    strip = known.state[(np.abs(z + 0.5566) < 0.012) & (x < 0.5)]
    assert (strip == NEARER).mean() > 0.9
    assert known.depth.dtype == np.float32 and known.state.dtype == np.uint8
    empty = seen_among(PLATE, AROUND, EYE, CUBE, "empty")
    unknown = known.state == UNKNOWN
    np.testing.assert_array_equal(empty.state[~unknown], known.state[~unknown])
    assert (empty.state[unknown] == BACKGROUND).all()
    np.testing.assert_allclose(empty.depth[unknown], 10)


def test_the_object_is_what_it_is_by_itself():
    """And what is before it leaves it surface."""
    before = plane(-1, (-1, 1), (-1, 1), 0.05)
    few = plane(0, (-0.5, 0.5), (-0.5, 0.5), 0.05)
    alone = jax.jit(seen_by)(few.astype(np.float32), EYE.astype(np.float32))
    for around in (np.zeros((0, 3)), before):
        known = seen_among(few, around, EYE, CUBE)
        surface = known.state == SURFACE
        assert (surface == (np.asarray(alone.state) == SURFACE)).mean() > 0.99
        np.testing.assert_allclose(known.depth[surface], 5, atol=1e-5)
        np.testing.assert_allclose(
            known.camera.intrinsics, alone.camera.intrinsics, rtol=1e-5, atol=1e-5
        )
        beside = known.state[2:-2, 2:-2][~surface[2:-2, 2:-2]]
        assert (beside == (NEARER if len(around) else UNKNOWN)).all()


def test_narrow_holes_are_closed_and_wide_ones_stay_open():
    """Rings far apart, as of a LiDAR; and a grid of three pixels between points."""
    rings = np.concatenate([plane(3, (-2, 2), (z, z), 0.01) for z in (0.9, -0.9)])
    grid = plane(3, (-2, 2), (-2, 2), 0.1)
    x, z = middles()
    state = seen_among(PLATE, rings, EYE, CUBE).state
    off = np.abs(np.abs(z) - 0.9 / 1.6)
    assert (state[off < 0.5 * 1.4 / MAP_SIZE] == BACKGROUND).all()
    assert (state[off > 2 * 1.4 / MAP_SIZE] != BACKGROUND).all()
    state = seen_among(PLATE, grid, EYE, CUBE).state
    inner = np.maximum(np.abs(x), np.abs(z)) < 0.6
    assert (state[inner] != UNKNOWN).all()


def test_what_cannot_be_seen_does_not_count():
    alone = seen_among(PLATE, np.zeros((0, 3)), EYE, CUBE)
    behind, aside = AROUND - [0, 20, 0], AROUND + [50, 0, 0]
    for around in (behind, aside, np.repeat(EYE[None], 3, axis=0)):
        known = seen_among(PLATE, around, EYE, CUBE)
        np.testing.assert_array_equal(known.state, alone.state)
        np.testing.assert_array_equal(known.depth, alone.depth)


def test_of_one_place_and_of_points_around_the_eye_there_is_a_map():
    for points in (np.zeros((1, 3)), np.zeros((3, 3)), EYE[None]):
        for around in (AROUND[:1], AROUND):
            known = seen_among(points, around, EYE, CUBE)
            assert np.isfinite(known.depth).all()
            assert (known.state == SURFACE).sum() == (points != EYE).any()
    around_eye = np.concatenate([PLATE, PLATE - [0, 8, 0]])
    known = seen_among(around_eye, AROUND, EYE, CUBE)
    np.testing.assert_allclose(known.camera.intrinsics[0, 0], 32 / 3**0.5)
    assert {SURFACE, UNKNOWN} <= set(known.state.ravel())


def test_free_space_in_closed_form():
    known = seen_among(PLATE, AROUND, EYE, CUBE)
    points = np.array(
        [
            (-0.6, 0.0, 0.0),  # beside the plate, before the wall
            (-0.6 * 1.7, 3.5, 0.0),  # behind the wall
            (-0.6 * 1.55, 2.75, 0.0),  # before it, by less than the tolerance
            (0.33, -2.6, 0.0),  # before the post, by less than the tolerance
            (0.33 * 0.8, -3.0, 0.0),  # before the post
            (0.65, 0.0, 0.0),  # behind the post
            (0.0, -1.0, 0.0),  # before the plate, which is another matter
            (-0.6, 0.0, 0.66),  # where nothing was measured
            (-2.0, 0.0, 0.0),  # beside the map
            (0.0, -9.0, 0.0),  # behind the eye
        ]
    )
    free = [True, False, False, False, True, False, False, False, False, False]
    np.testing.assert_array_equal(in_free_space(points, known, 0.3), free)
    assert in_free_space(points[:0], known, 0.3).shape == (0,)


def test_what_was_looked_past_is_left_away_but_for_the_rim():
    """The background says nothing about points near the object's silhouette."""
    few = PLATE[::7]
    reach = PAST * IndexedCloud(few).spacing
    known = seen_among(PLATE, WALL, EYE, Workspace.unit())
    beside = np.array([(-0.5 - far * reach, 0.0, 0.0) for far in (0.5, 0.9, 1.1)])
    prediction = np.concatenate([beside, PLATE[:5] + [0, 0.2, 0]])
    blind = select(prediction, PLATE, few, EYE)
    told = select(prediction, PLATE, few, EYE, visibility=known)
    assert not blind.looked_through.any()
    np.testing.assert_array_equal(told.looked_through, [0, 0, 1] + [0] * 5)
    np.testing.assert_array_equal(told.kept, blind.kept & ~told.looked_through)
    lost = select(prediction, PLATE, few, None, visibility=known)
    assert not lost.looked_through.any()


def test_rays_leave_a_box_where_they_should():
    eye, box = np.array([-3.0, 0, 0]), (-np.ones(3), np.ones(3))
    rays = np.array([(1.0, 0, 0), (2, 0, 0), (1, 0.3, 0), (-1, 0, 0), (1, 1, 0)])
    np.testing.assert_allclose(box_exit(eye, rays, *box), [4, 2, 10 / 3, 0, 0])
    inside = box_exit(np.zeros(3), rays, *box)
    np.testing.assert_allclose(inside, [1, 0.5, 1, 1, 1])
