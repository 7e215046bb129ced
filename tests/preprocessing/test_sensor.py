"""Where sensors may have stood, of shells that were seen from known places."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prism_jax.preprocessing.sensor import (
    hidden_share,
    is_believable,
    is_closed,
    likely_eye,
)

FAR = np.array([4e5, 5e6, 100.0])


def shell(direction, count=2000, seed=0):
    """What is seen of an ellipsoid from far away in a direction."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= np.sign(points @ direction)[:, None]
    return points * [1.0, 0.8, 0.6]


def directions(count):
    rng = np.random.default_rng(1)
    found = rng.normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def angle(points, eye, direction):
    """In degrees, seen from the middle of the points' box."""
    toward = eye - 0.5 * (points.min(axis=0) + points.max(axis=0))
    cosine = toward @ direction / np.linalg.norm(toward)
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.parametrize("row", range(4))
def test_a_shell_bulges_toward_its_sensor(row):
    direction = directions(8)[row]
    points = shell(direction)
    eye = likely_eye(points)
    assert angle(points, eye, direction) < 45
    assert np.linalg.norm(eye) > 3
    there = likely_eye(1e3 * points + FAR)
    np.testing.assert_allclose(there, 1e3 * eye + FAR, atol=1e-2)


@pytest.mark.parametrize("row", range(3))
def test_it_turns_with_the_points(row):
    turn = Rotation.from_rotvec([[0, 0, np.pi / 4], [1, 2, 3], [-2, 0, 1]][row])
    points, up = shell(directions(8)[row]), np.array([0, 0, 1.0])
    turned, turned_up = turn.apply(points) + [3, 2, 1], turn.apply(up)
    here, there = likely_eye(points, up), likely_eye(turned, turned_up)
    np.testing.assert_allclose(there, turn.apply(here) + [3, 2, 1], atol=1e-6)
    # From where the middle of a shell's box would hide some of it.
    aside = 2 * directions(8)[-1 - row]
    share = hidden_share(points, aside)
    assert hidden_share(turned, turn.apply(aside) + [3, 2, 1]) == share


def test_it_is_seldom_below():
    """A flat thing looks the same from above and from below."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(1000, 3)) * [1, 1, 0.01]
    for up in (np.array([0, 0, 1.0]), np.array([0, 0, -1.0])):
        assert (likely_eye(points, up) - points.mean(axis=0)) @ up > 3


def test_what_lies_behind_is_hidden():
    """The far half of a ball, but for its rim; nothing of the near half."""
    direction = np.array([0.0, 0.0, 1.0])
    near, far = shell(direction), shell(-direction)
    eye = np.array([0.0, 0.0, 8.0])
    assert hidden_share(near, eye) < 0.05
    assert 0.15 < hidden_share(np.concatenate([near, far]), eye) < 0.5
    assert hidden_share(near, near.mean(axis=0)) == 1.0


def test_a_place_that_would_not_have_seen_the_points_is_not_believed():
    """Three sides of a box, from where they were seen and from across."""
    points = np.random.default_rng(0).uniform(-1, 1, (3, 600, 3))
    points[range(3), :, range(3)] = 1.0
    points = points.reshape(-1, 3)
    likely = likely_eye(points)
    toward = np.array([1.0, 1.0, 1.0])
    assert angle(points, likely, toward / np.sqrt(3)) < 60
    assert is_believable(points, 5 * toward, likely)
    assert is_believable(points, likely, likely)
    assert not is_believable(points, np.array([5.0, -5.0, -0.5]), likely)


def test_degenerate_clouds_have_some_place():
    line = np.arange(9.0)[:, None] * [1, 2, 3]
    for points in (np.zeros((1, 3)), np.zeros((9, 3)), np.eye(3)[:2], line):
        eye = likely_eye(points)
        assert np.isfinite(eye).all()
        assert 0 <= hidden_share(points, eye) <= 1
        assert is_believable(points, eye, eye)


def test_a_cloud_all_around_is_closed_though_it_stood_on_something():
    ball = np.concatenate([shell(sign * FAR) for sign in (-1, 1)])
    assert is_closed(1e3 * ball + FAR) and is_closed(ball[ball[:, 2] > -0.5])
    assert not is_closed(ball[ball[:, 0] > -0.3]) and not is_closed(ball[:900])
    assert not is_closed(ball, thickness=0.5)
    # A hollow thing, and its upper half.
    turn, slope = np.random.default_rng(0).uniform(0, 2 * np.pi, (2, 4000))
    far, high = 1 + 0.3 * np.cos(slope), 0.3 * np.sin(slope)
    ring = np.stack([far * np.cos(turn), far * np.sin(turn), high], axis=1)
    assert is_closed(ring) and not is_closed(ring[high > 0])
