import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.simulation.sensors import l515_camera
from prism_jax.envelope.distance import KINDS
from prism_jax.envelope.surfaces import PART_MARGIN, Method, see, sensor_name
from prism_jax.io.errors import InputError
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


def test_a_known_part_has_a_margin_of_its_own(monkeypatch):
    part = POINTS[:100] + 5.0
    surface = SimpleNamespace(size=2.0)
    found = SimpleNamespace(
        model=SimpleNamespace(surface=surface), placed=lambda: (part, None)
    )
    complete = FakeCompleter.complete

    def known(*given, **asked):
        return dataclasses.replace(complete(*given, **asked), known=found)

    monkeypatch.setattr(FakeCompleter, "complete", known)
    surfaces = see(FakeCompleter(), POINTS, None, Method(known="parts")).surfaces()
    np.testing.assert_array_equal(surfaces.points["part"], part)
    beside = part[:1] + [0.0, 0.0, 20.0]
    away, kind = surfaces.distance(beside, 1.0)
    reach = np.linalg.norm(beside - part, axis=1).min()
    assert away[0] == pytest.approx(reach - 2.0 * PART_MARGIN)
    assert KINDS[kind[0]] == "part"


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
