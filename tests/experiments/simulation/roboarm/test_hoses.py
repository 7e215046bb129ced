import dataclasses

import numpy as np
import pytest

from experiments.simulation.roboarm.tooling import random_hoses, random_tool
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
