"""Halls and rooms, and what could be taken for one."""

import numpy as np
import pytest

from prism_jax.preprocessing.segmentation.background import bounding, sees_scene
from prism_jax.preprocessing.segmentation.planes import Thinned

LOWER, UPPER = np.array([-9.0, -6.0, -1.5]), np.array([12.0, 5.0, 2.5])


def room(azimuths, elevations):
    """What a sensor at the origin measures of a room from within."""
    grid = np.meshgrid(np.deg2rad(azimuths) + 1e-3, np.deg2rad(elevations) + 1e-3)
    az, el = map(np.ravel, grid)
    rays = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], -1)
    with np.errstate(divide="ignore"):
        walls = np.where(rays > 0, UPPER, LOWER) / rays
    return walls.min(axis=1)[:, None] * rays


def box(half):
    """All sides of a box about the origin."""
    points = np.random.default_rng(0).uniform(-1, 1, (6000, 3))
    return points / np.abs(points).max(axis=1, keepdims=True) * half


SWEEP = room(np.arange(-180, 180, 1.5), np.linspace(-25, 15, 32))
VIEW = room(np.arange(-35, 35, 0.7), np.arange(-30, 5, 0.7))


@pytest.mark.parametrize("points", [SWEEP, VIEW, SWEEP[:, [0, 2, 1]]])
def test_a_room_is_a_scene_whether_its_sensor_is_given_or_not(points):
    assert sees_scene(points) and sees_scene(points + 1e3, np.full(3, 1e3))


def test_planes_end_a_view_if_nothing_lies_behind_them():
    """The front of a large cabinet in the room ends nothing."""
    cabinet = (np.abs(VIEW[:, 1]) < 0.3 * VIEW[:, 0]) & (VIEW[:, 2] < 0.0)
    near = np.where(cabinet & (VIEW[:, 0] > 4.0), 4.0 / VIEW[:, 0], 1.0)
    thinned = Thinned(VIEW * near[:, None])
    front = [plane for plane in thinned.planes if abs(abs(plane.offset) - 4.0) < 0.1]
    ends = bounding(thinned, np.zeros(3))
    assert len(front) == 1 and front[0] not in ends and len(ends) >= 2


def test_one_object_is_no_scene():
    """Neither before a sensor nor about the origin, whole or seen from one side."""
    whole, eye = box([0.9, 0.5, 0.4]), np.array([2.0, 1.0, 1.5])
    side = whole[np.abs(whole @ [1, 0, 0] - 0.9) < 1e-9]
    seen = whole[(whole / [0.9, 0.5, 0.4]).max(axis=1) > 1 - 1e-9]
    for points in (whole, side, seen):
        assert not sees_scene(points, eye)
        assert not sees_scene(points - points.mean(axis=0))


def test_a_floor_and_what_is_above_it_are_a_scene_where_up_is_known():
    rng, up = np.random.default_rng(0), np.array([0.0, 0.0, 1.0])
    floor = rng.uniform(-2, 2, (20_000, 3)) * [1, 1, 1e-4] + [9, 0, 0]
    top = rng.uniform(-0.4, 0.4, (400, 3)) * [1, 1, 0.05] + [9, 0, 0.7]
    for height, found in ((1.0, True), (-1.0, False)):  # a table on it, or legs below
        points = np.concatenate([floor, top * [1, 1, height]])
        assert sees_scene(points, up=up) == found
        assert not sees_scene(points) and not sees_scene(points, up=up[::-1])
    assert not sees_scene(floor, up=up)
