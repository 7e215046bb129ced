import dataclasses

import numpy as np
import pytest

from experiments.simulation.roboarm.hoses import random_hoses
from experiments.simulation.roboarm.tooling import random_tool
from experiments.simulation.roboarm.workcells import arm_of


@pytest.fixture(scope="module")
def arm(model):
    return arm_of(dataclasses.replace(model, tool_link="lower"))


def test_hoses_lead_from_the_foot_to_the_tool_in_every_pose(arm):
    rng = np.random.default_rng(1)
    tool = random_tool(arm.reach, rng)
    hoses = random_hoses(arm.robot, "lower", tool, arm.reach, rng)
    for positions in rng.uniform(arm.robot.lower, arm.robot.upper, (4, 3)):
        mesh = hoses.mesh(arm.robot, positions)
        pose = arm.robot.frame_pose("lower", positions)
        for anchors in hoses.strands:
            assert [anchor.link for anchor in anchors] == [
                "base",
                "turret",
                "upper",
                "lower",
            ]
            assert np.linalg.norm(anchors[-1].point) < tool.size
            for link, anchor in (("base", anchors[0]), ("lower", anchors[-1])):
                pose = arm.robot.frame_pose(link, positions)
                at = pose[:3, :3] @ anchor.point + pose[:3, 3]
                gaps = np.linalg.norm(mesh.vertices - at, axis=1)
                assert gaps.min() < 1.01 * hoses.radius


def test_hoses_are_held_on_the_surface_of_links(arm):
    """By the box that the upper arm is."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        tool = random_tool(arm.reach, rng)
        hoses = random_hoses(arm.robot, "lower", tool, arm.reach, rng)
        for anchors in hoses.strands:
            (anchor,) = [a for a in anchors if a.link == "upper"]
            outside = np.abs(anchor.point[:2]).max() - 0.035
            assert 0 < outside < 0.06
            assert anchor.point[2] == pytest.approx(0.2)
            assert anchor.out @ anchor.along == pytest.approx(0)


def test_an_arm_of_few_links_has_no_hoses(arm):
    rng = np.random.default_rng(0)
    assert random_hoses(arm.robot, "upper", random_tool(1.0, rng), 1.0, rng) is None
