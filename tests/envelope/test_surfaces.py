import dataclasses

import numpy as np
import pytest

from prism_jax.envelope.surfaces import FLOOR, Method, see, sensor_name
from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import InputError
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, (300, 3))


class WithErrors(FakeCompleter):
    """Expects an error of a tenth of each added point's x."""

    def complete(self, points, camera=None, **asked):
        done = super().complete(points, camera, **asked)
        errors = np.where(done.observed, 0.0, 0.1 * done.points[:, 0])
        wrapped = Wrapped(done)
        wrapped.sigma = errors
        return wrapped


class Wrapped:
    def __init__(self, done):
        self.__dict__ |= {
            f.name: getattr(done, f.name) for f in dataclasses.fields(done)
        }


def test_what_is_measured_stays_and_what_is_added_is_predicted():
    seen = see(FakeCompleter(), POINTS, None, Method())
    np.testing.assert_array_equal(seen.measured, POINTS)
    assert len(seen.predicted) == 150 and seen.fault == ""
    assert len(seen.robot) == len(seen.set_aside) == 0
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


@pytest.mark.parametrize("count", [0, 1, 63])
def test_too_few_points_are_measured_and_not_completed(count):
    seen = see(FakeCompleter(), POINTS[:count], None, Method())
    assert len(seen.measured) == count and len(seen.predicted) == 0
    assert seen.fault


def test_a_robot_that_the_method_does_not_know_is_refused():
    with pytest.raises(InputError, match="none was calibrated"):
        see(FakeCompleter(), POINTS, None, Method(), robot=POINTS)
    with pytest.raises(InputError, match="is missing"):
        see(FakeCompleter(), POINTS, None, Method(robot="known"))


def test_supports_are_set_aside_and_have_no_margin():
    points = POINTS.copy()
    points[::3, 2] *= -1
    seen = see(FakeCompleter(), points, None, Method(objects="auto"))
    assert len(seen.set_aside) == 100 and (seen.set_aside[:, 2] < 0).all()
    assert len(seen.measured) == 200 and (seen.measured[:, 2] > 0).all()


def test_scales_are_the_expected_errors_above_a_floor():
    seen = see(WithErrors(), POINTS, None, Method())
    np.testing.assert_allclose(seen.sigma, 0.1 * seen.predicted[:, 0])
    scaled = seen.surfaces(FLOOR)
    assert scaled.reach(1.0) == pytest.approx(0.1 * 2, rel=0.5)
    point = np.full((1, 3), 50.0)
    # In scales: far away, the widest scale decides.
    assert scaled.needed(point)[0] > seen.surfaces().needed(point)[0]
    with pytest.raises(InputError, match="tell no error"):
        see(FakeCompleter(), POINTS, None, Method()).surfaces(FLOOR)


def test_the_sensor_is_called_by_its_image():
    assert sensor_name(Camera.l515()) == "camera 640x480, 70x55 degrees"
    assert sensor_name(None) is None
