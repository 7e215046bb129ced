"""Robots against trigonometry and yourdfpy."""

import importlib.util
import io
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import yourdfpy

from experiments.simulation.roboarm.models import ARMS, CELL_ARMS, ArmModel, urdf_path
from experiments.simulation.roboarm.robots import Robot
from prism_jax.robots.xacro import plain_urdf
from tests.robots.test_urdf import ELBOW, changed, mimic

BY_SPLIT = {split: {*arms, *CELL_ARMS.get(split, ())} for split, arms in ARMS.items()}
HAS_INDUSTRIAL = importlib.util.find_spec("rtbdata") is not None
# One with a tool, one that is taken off a robot and turned, one of xacro.
QUICK = {"ur10", "romeo", "kr3r540"}


def marks(model):
    missing = model.package == "rtb-data" and not HAS_INDUSTRIAL
    reason = "needs rtb-data: pip install '.[robots]'"
    found = [pytest.mark.skipif(missing, reason=reason)]
    return found if model.name in QUICK else [*found, pytest.mark.slow]


def test_a_mimic_follows_and_belongs_to_the_part_that_carries_it(tmp_path):
    told = mimic("shoulder", 'multiplier="-0.5" offset="0.1"')
    path = changed(tmp_path, ELBOW, told)
    robot = Robot(ArmModel("variant", "test", str(path)))
    assert robot.joints == ("yaw", "shoulder")
    assert robot.bodies.tolist() == [0, 1, 2, 2]
    pose = robot.link_poses(np.array([[0.0, 0.8]]))[0, 3]
    angle = np.arctan2(pose[0, 2], pose[2, 2])
    assert angle == pytest.approx(0.8 + 0.1 - 0.5 * 0.8)


def test_no_family_of_arms_is_in_two_splits():
    families = [{model.family for model in arms} for arms in BY_SPLIT.values()]
    assert sum(map(len, families)) == len(set.union(*families))
    every = [model for arms in BY_SPLIT.values() for model in arms]
    assert len({m.urdf for m in every}) == len({m.name for m in every}) == len(every)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(model, id=model.name, marks=marks(model))
        for arms in BY_SPLIT.values()
        for model in sorted(arms, key=lambda model: model.name)
    ],
)
def test_every_arm_moves_as_yourdfpy_says_and_hangs_together(model):
    robot = Robot(model)
    rng = np.random.default_rng(0)
    positions = rng.uniform(robot.lower, robot.upper, (2, len(robot.joints)))
    path = urdf_path(model)
    file = (
        io.BytesIO(ElementTree.tostring(plain_urdf(path)))
        if path.suffix == ".xacro"
        else str(path)
    )
    oracle = yourdfpy.URDF.load(file, load_meshes=False)
    oracle.update_cfg(dict(zip(robot.joints, positions[0].tolist(), strict=True)))
    poses = robot.link_poses(positions)
    links = list(robot.link_names)
    for name, pose in zip(links, poses[0], strict=True):
        expected = oracle.get_transform(name, links[0])
        found = np.linalg.inv(poses[0, 0]) @ pose
        np.testing.assert_allclose(found, expected, atol=1e-9)
    probes, bodies = robot.probe_points(positions), robot.bodies[robot.probe_links]
    reach = np.linalg.norm(probes, axis=-1).max()
    for body in set(robot.bodies.tolist()) - {min(robot.bodies)}:
        own, others = probes[:, bodies == body], probes[:, bodies < body]
        gaps = np.linalg.norm(own[:, :, None] - others[:, None], axis=-1)
        assert gaps.min(axis=(1, 2)).max() < 0.1 * max(1, reach)
    assert 0.25 < reach < 3.8
