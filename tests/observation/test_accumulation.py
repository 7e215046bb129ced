"""A wall, and a ball that passes before it, seen by a sensor at the origin."""

import numpy as np
import pytest

from prism_jax.observation.accumulation import STEADY, SURE, Accumulator

EYE = np.zeros(3)
VOXEL = 0.05
RNG = np.random.default_rng(0)


def seen(ball=None):
    """Points of a wall at x = 2 that the ball, of 0.2 m and at x = 1, does not hide;
    and those of the ball's near side."""
    y, z = (0.02 * (np.indices((80, 80)).reshape(2, -1) - 40)).astype(np.float64)
    wall = np.stack([np.full(len(y), 2.0), y, z], axis=1)
    if ball is None:
        return wall, np.zeros((0, 3))
    center = np.array([1.0, *ball])
    rays = wall / np.linalg.norm(wall, axis=1, keepdims=True)
    along = rays @ center
    aside = center @ center - along**2
    hits = aside < 0.2**2
    depth = along[hits] - np.sqrt(0.2**2 - aside[hits])
    return wall[~hits], rays[hits] * depth[:, None]


def run(accumulator, frames):
    lacking = None
    for ball in frames:
        wall, near = seen(ball)
        points = np.concatenate([wall, near])
        points = points + RNG.normal(scale=0.001, size=points.shape)
        lacking = accumulator.add(points, points, EYE)
    return lacking


def test_what_is_hidden_now_is_remembered():
    accumulator = Accumulator(VOXEL)
    assert len(run(accumulator, [None] * 4)) == 0
    lacking = run(accumulator, [(0.0, 0.0)])
    np.testing.assert_allclose(lacking[:, 0], 2.0, atol=0.01)
    # The ball's shadow: 0.4 m wide at twice its distance, without a voxel's rim.
    assert len(lacking) > 30
    aside = np.linalg.norm(lacking[:, 1:], axis=1)
    assert aside.max() < 0.42 and aside.min() < 0.1


def test_what_was_never_seen_is_not():
    accumulator = Accumulator(VOXEL)
    assert len(run(accumulator, [(0.0, 0.0)] * 8)) == 0


def test_what_moves_leaves_nothing_behind():
    accumulator = Accumulator(VOXEL)
    run(accumulator, [None] * 4)
    for step in range(20):
        lacking = run(accumulator, [(0.05 * step - 0.7, 0.0)])
        assert (lacking[:, 0] > 1.9).all()
    assert len(lacking) > 30


def test_what_stood_long_is_forgotten_once_it_has_gone():
    accumulator = Accumulator(VOXEL)
    run(accumulator, [(0.0, 0.0)] * 20)
    for frame in range(SURE + 1):
        # At once it is not among what a frame lacks, for the wall shows behind it.
        lacking = run(accumulator, [None])
        assert len(lacking) == 0, frame
    wall_only = len(accumulator)
    run(accumulator, [None])
    assert len(accumulator) == pytest.approx(wall_only, rel=0.05)
    assert not (accumulator._points[:, 0] < 1.5).any()


def test_memory_is_bounded_by_what_is_there():
    accumulator = Accumulator(VOXEL)
    sizes = []
    for step in range(40):
        run(accumulator, [(0.03 * step - 0.6, 0.1)])
        sizes.append(len(accumulator))
    # A wall of 1.6 m by 1.6 m may lie in two layers of voxels.
    assert max(sizes) < 2.5 * (1.6 / VOXEL) ** 2


def test_a_lost_return_forgets_nothing_and_steady_frames_are_needed():
    wall, _ = seen()
    accumulator = Accumulator(VOXEL)
    half = wall[:, 1] < 0
    for number in range(1, 2 * STEADY):
        lacking = accumulator.add(wall, wall, EYE)
        after = Accumulator(VOXEL)
        for name in ("_keys", "_points", "_counts"):
            setattr(after, name, getattr(accumulator, name).copy())
        lacking = after.add(wall[half], wall[half], EYE)
        assert (len(lacking) > 100) == (number >= STEADY)
        assert (lacking[:, 1] >= 0).all()


def test_background_outside_the_workspace_counts():
    """The wall is cropped away, and still shows that the ball has gone."""
    accumulator = Accumulator(VOXEL)
    wall, ball = seen((0.0, 0.0))
    for _ in range(6):
        accumulator.add(ball, np.concatenate([wall, ball]), EYE)
    blind = accumulator.add(ball[:1], ball[:1], EYE)
    assert len(blind) > 20
    wall, _ = seen()
    assert len(accumulator.add(ball[:1], wall, EYE)) == 0


def test_empty_frames_and_odd_voxels():
    accumulator = Accumulator(VOXEL)
    none = np.zeros((0, 3))
    assert accumulator.add(none, none, EYE).shape == (0, 3)
    for _ in range(STEADY):
        accumulator.add(np.ones((3, 3)), np.ones((3, 3)), EYE)
    np.testing.assert_array_equal(accumulator.add(none, none, EYE), np.ones((1, 3)))
    for side in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="wide"):
            Accumulator(side)
