import numpy as np
import pytest

from experiments.simulation.sensors import l515_camera
from prism_jax.envelope.surfaces import Method, see, sensor_name
from prism_jax.io.errors import InputError
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, (300, 3))


def test_what_is_measured_stays_and_what_is_added_is_predicted():
    seen = see(FakeCompleter(), POINTS, None, Method())
    np.testing.assert_array_equal(seen.measured, POINTS)
    assert len(seen.predicted) == 150 and seen.fault == ""
    assert len(seen.robot) == 0
    assert len(seen.surfaces()) == 450


def test_a_known_robot_is_cut_out_and_put_back():
    robot = POINTS[:150] + 0.001
    method = Method(robot="box", robot_margin=0.01)
    seen = see(FakeCompleter(), POINTS, None, method, robot=robot)
    own = np.linalg.norm(POINTS[:, None] - robot, axis=2).min(axis=1) < 0.01
    np.testing.assert_array_equal(seen.measured, POINTS[~own])
    np.testing.assert_array_equal(seen.robot, robot)
    apart = np.linalg.norm(seen.predicted[:, None] - robot, axis=2).min(axis=1)
    assert (apart >= 0.01).all()
    assert 0 < len(seen.predicted) <= -(-(~own).sum() // 2)


def test_where_the_robot_is_all_there_is_nothing_is_predicted_and_it_is_said():
    method = Method(robot="box")
    seen = see(FakeCompleter(), POINTS, None, method, robot=POINTS)
    assert len(seen.measured) == len(seen.predicted) == 0
    assert "no points" in seen.fault
    assert len(seen.surfaces()) == 300


@pytest.mark.parametrize("count", [0, 63])
def test_too_few_points_are_measured_and_not_completed(count):
    seen = see(FakeCompleter(), POINTS[:count], None, Method())
    assert len(seen.measured) == count and len(seen.predicted) == 0
    assert seen.fault


def test_a_scan_that_the_completer_refuses_is_measured_and_not_completed():
    class Refusing(FakeCompleter):
        def complete(self, *given, **asked):
            raise InputError("the scan", "only strays", "scan more of it")

    seen = see(Refusing(), POINTS, None, Method())
    np.testing.assert_array_equal(seen.measured, POINTS)
    assert len(seen.predicted) == 0 and "only strays" in seen.fault


def test_a_robot_that_the_method_does_not_know_is_refused():
    with pytest.raises(InputError, match="not part of the calibration"):
        see(FakeCompleter(), POINTS, None, Method(), robot=POINTS)
    with pytest.raises(InputError, match="the robot: missing"):
        see(FakeCompleter(), POINTS, None, Method(robot="box"))


def test_a_margin_is_laid_around_all_that_was_measured_but_the_robot():
    others = np.concatenate([POINTS[:9], [[9.0, 9, 9]]])
    method = Method(robot="box", robot_margin=0.001)
    seen = see(FakeCompleter(), POINTS, None, method, robot=POINTS[:120], others=others)
    expected = np.concatenate([POINTS[120:], others[9:]])
    np.testing.assert_array_equal(seen.measured, expected)


def test_the_sensor_is_called_by_its_image():
    camera = l515_camera(np.eye(3), np.zeros(3))
    assert sensor_name(camera) == "camera 640x480, 70x55 degrees"
    assert sensor_name(None) is None
