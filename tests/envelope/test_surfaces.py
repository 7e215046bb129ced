import numpy as np
import pytest

from experiments.simulation.sensors import l515_camera
from prism_jax.completion.assembly import CompletedScan
from prism_jax.envelope.surfaces import Method, see, sensor_name
from prism_jax.io.errors import InputError
from prism_jax.io.ply import COMPLETED, KNOWN, OBSERVED
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).uniform(1, 2, (300, 3))


def test_what_is_measured_stays_and_what_is_added_is_predicted():
    seen = see(FakeCompleter(), POINTS, None, Method())
    np.testing.assert_array_equal(seen.measured, POINTS)
    assert len(seen.predicted) == 150 and seen.fault == ""
    assert len(seen.robot) == 0
    assert sum(map(len, seen.surfaces().points.values())) == 450


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


def test_hidden_surfaces_of_a_known_model_count_as_a_robots_do(monkeypatch):
    label = np.repeat([OBSERVED, COMPLETED, KNOWN], [300, 50, 100])
    monkeypatch.setattr(CompletedScan, "label", label)
    seen = see(FakeCompleter(), POINTS, None, Method(known="parts"))
    assert (len(seen.measured), len(seen.predicted), len(seen.robot)) == (300, 50, 100)
    assert sum(map(len, seen.surfaces().points.values())) == 450


class Refusing(FakeCompleter):
    def complete(self, *given, **asked):
        raise InputError("the scan", "only strays", "scan more of it")


@pytest.mark.parametrize(
    ("completer", "count", "robot", "told"),
    [
        (FakeCompleter(), 0, None, "no points"),
        (FakeCompleter(), 63, None, "63 distinct points"),
        (FakeCompleter(), 300, "box", "no points"),  # the robot is all there is
        (Refusing(), 300, None, "only strays"),
    ],
)
def test_what_cannot_be_completed_is_measured_and_it_is_said(
    completer, count, robot, told
):
    known = None if robot is None else POINTS
    seen = see(completer, POINTS[:count], None, Method(robot=robot), robot=known)
    assert len(seen.predicted) == 0 and told in seen.fault
    assert len(seen.measured) == (0 if robot else count)
    assert sum(map(len, seen.surfaces().points.values())) == count


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
