import numpy as np
from scipy.interpolate import BPoly

from experiments.simulation.roboarm.models import ArmModel
from experiments.simulation.roboarm.robots import Robot
from experiments.simulation.roboarm.trajectories import (
    FLOOR_GAP,
    Clearance,
    minimum_jerk,
    random_trajectory,
)
from tests.experiments.simulation.roboarm import conftest as boxes


def test_minimum_jerk_is_the_quintic_from_rest_to_rest():
    times = np.linspace(0, 1, 21)
    start, end = np.array([0.3, -1.0]), np.array([1.0, 2.0])
    rest = np.zeros(2)
    expected = BPoly.from_derivatives([0, 1], [[start, rest, rest], [end, rest, rest]])
    np.testing.assert_allclose(minimum_jerk(start, end, times), expected(times))


def test_a_link_that_folds_back_onto_the_base_is_seen(tmp_path):
    """A third link that is as long as the way back."""
    third = (
        '<link name="third"><visual><origin xyz="0 0 0.15"/><geometry>'
        '<box size="0.05 0.05 0.3"/></geometry></visual></link>'
        + boxes.joint("wrist", "lower", "third", boxes.LOWER, "0 1 0")
    )
    path = tmp_path / "third.urdf"
    path.write_text(boxes.URDF.replace("</robot>", third + "</robot>"))
    clearance = Clearance(Robot(ArmModel("third", "test", str(path))))
    # Of the triangle of links 0.4, 0.3 and 0.3, the last corner is at the shoulder.
    elbow = np.arccos((0.4**2 + 0.3**2 - 0.3**2) / (2 * 0.4 * 0.3))
    apex = np.arccos((0.3**2 + 0.3**2 - 0.4**2) / (2 * 0.3 * 0.3))
    folded = [0, 0, np.pi - elbow, np.pi - apex]
    poses = np.array([folded, [0, 0, 0.3, 0.3]])
    assert clearance.is_free(poses).tolist() == [False, True]


def test_trajectories_stay_within_limits_and_clear(model):
    robot = Robot(model)
    path = random_trajectory(robot, 30, 4, np.random.default_rng(1))
    assert path.shape == (30, 3)
    assert (path >= robot.lower).all() and (path <= robot.upper).all()
    probes = robot.probe_points(path)
    moving = robot.bodies[robot.probe_links] > 0
    assert probes[:, moving, 2].min() > FLOOR_GAP
    steps = np.abs(np.diff(path, axis=0)).max(axis=1)
    assert 0.05 < steps.max() < 1.0
    again = random_trajectory(robot, 30, 4, np.random.default_rng(1))
    np.testing.assert_array_equal(path, again)
