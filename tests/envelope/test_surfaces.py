import dataclasses

import numpy as np
import pytest

from prism_jax.envelope.surfaces import (
    FLOOR,
    THIN,
    Method,
    see,
    sensor_name,
    thinned,
)
from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import InputError
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, (300, 3))


class WithErrors(FakeCompleter):
    """Expects an error of a tenth of each added point's x."""

    def complete(self, points, camera=None, **asked):
        done = super().complete(points, camera, **asked)
        sigma = np.where(done.observed, 0.0, 0.1 * done.points[:, 0])
        return dataclasses.replace(done, sigma=sigma)


def test_what_is_measured_stays_and_what_is_added_is_predicted():
    seen = see(FakeCompleter(), POINTS, None, Method())
    np.testing.assert_array_equal(seen.measured, POINTS)
    assert len(seen.predicted) == 150 and seen.fault == ""
    assert len(seen.robot) == 0
    assert len(seen.surfaces()) == 450


@pytest.mark.parametrize("completed", ["all", "rest"])
def test_a_known_robot_is_cut_out_and_put_back(completed):
    robot = POINTS[:150] + 0.001
    method = Method(robot="known", robot_margin=0.01, completed=completed)
    seen = see(FakeCompleter(), POINTS, None, method, robot=robot)
    own = np.linalg.norm(POINTS[:, None] - robot, axis=2).min(axis=1) < 0.01
    np.testing.assert_array_equal(seen.measured, POINTS[~own])
    np.testing.assert_array_equal(seen.robot, robot)
    apart = np.linalg.norm(seen.predicted[:, None] - robot, axis=2).min(axis=1)
    assert (apart >= 0.01).all()
    used = len(POINTS) if completed == "all" else (~own).sum()
    assert 0 < len(seen.predicted) <= -(-used // 2)


def test_where_the_robot_is_all_there_is_nothing_is_predicted_and_it_is_said():
    method = Method(robot="known", completed="rest")
    seen = see(FakeCompleter(), POINTS, None, method, robot=POINTS)
    assert len(seen.measured) == len(seen.predicted) == 0
    assert "no points" in seen.fault
    assert len(seen.surfaces(FLOOR)) == 300


@pytest.mark.parametrize("count", [0, 63])
def test_too_few_points_are_measured_and_not_completed(count):
    seen = see(FakeCompleter(), POINTS[:count], None, Method())
    assert len(seen.measured) == count and len(seen.predicted) == 0
    assert seen.fault


def test_a_robot_that_the_method_does_not_know_is_refused():
    with pytest.raises(InputError, match="not part of the calibration"):
        see(FakeCompleter(), POINTS, None, Method(), robot=POINTS)
    with pytest.raises(InputError, match="the robot: missing"):
        see(FakeCompleter(), POINTS, None, Method(robot="known"))


def test_supports_and_what_is_beside_the_scan_have_a_margin_or_none():
    points = POINTS.copy()
    points[::3, 2] *= -1
    others = np.array([[9.0, 9, 9], [9.001, 9, 9], [8, 8, 8]])
    method = Method(objects="auto", around="objects")
    seen = see(FakeCompleter(), points, None, method, others=others)
    assert len(seen.measured) == 200 and (seen.measured[:, 2] > 0).all()
    method = Method(objects="auto")
    all_of_it = see(FakeCompleter(), points, None, method, others=others)
    np.testing.assert_array_equal(all_of_it.measured[:200], seen.measured)
    # Of two neighbours one is kept.
    np.testing.assert_array_equal(all_of_it.measured[200:202], others[[0, 2]])
    np.testing.assert_array_equal(all_of_it.measured[202:], points[::3])


@pytest.mark.parametrize("completed", ["all", "rest"])
def test_a_robots_points_are_never_measured(completed):
    points = POINTS.copy()
    points[::3, 2] *= -1
    robot = points[:120]
    method = Method(
        objects="auto", robot="known", robot_margin=0.001, completed=completed
    )
    seen = see(FakeCompleter(), points, None, method, robot=robot, others=robot)
    expected = {tuple(point) for point in points[120:]}
    assert {tuple(point) for point in seen.measured} == expected


def test_thinning_keeps_the_first_point_of_each_cube():
    rng = np.random.default_rng(3)
    points = 1e5 + rng.uniform(0, 0.3, (2000, 3))
    kept = thinned(points)
    cubes = [tuple(cube) for cube in np.floor(points / THIN).astype(int)]
    first = {}
    for cube, point in zip(cubes, points, strict=True):
        first.setdefault(cube, tuple(point))
    assert [tuple(point) for point in kept] == list(first.values())
    assert thinned(points[:0]).shape == (0, 3)


def test_scales_are_the_expected_errors_above_a_floor():
    seen = see(WithErrors(), POINTS, None, Method())
    np.testing.assert_allclose(seen.sigma, 0.1 * seen.predicted[:, 0])
    scaled = seen.surfaces(FLOOR)
    assert scaled.reach(1.0) == pytest.approx(0.1 * 2, rel=0.5)
    point = np.full((1, 3), 50.0)
    # In scales: far away, the widest scale decides.
    assert scaled.needed(point)[0] > seen.surfaces().needed(point)[0]
    with pytest.raises(InputError, match="no per-point errors"):
        see(FakeCompleter(), POINTS, None, Method()).surfaces(FLOOR)


def test_the_sensor_is_called_by_its_image():
    assert sensor_name(Camera.l515()) == "camera 640x480, 70x55 degrees"
    assert sensor_name(None) is None
