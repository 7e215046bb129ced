import dataclasses

import numpy as np
import pytest

from experiments.simulation.roboarm.tooling import (
    TOOL_SIZES,
    TOOLS,
    on_flange,
    random_tool,
)
from experiments.simulation.roboarm.workcells import arm_of


@pytest.fixture(scope="module")
def arm(model):
    return arm_of(dataclasses.replace(model, tool_link="lower"))


def tools():
    return [random_tool(1.0, np.random.default_rng(seed)) for seed in range(40)]


def test_tools_begin_at_the_flange_and_are_of_every_kind():
    made = tools()
    assert {tool.kind for tool in made} == set(TOOLS)
    for tool in made:
        assert TOOL_SIZES[0] <= tool.size <= TOOL_SIZES[1]
        lower, upper = tool.mesh.bounds
        assert -0.25 * tool.size < lower[2] <= 0.01 * tool.size
        assert 0.4 * tool.size < upper[2] < 3.2 * tool.size
        # Changer, tool and workpiece are closed solids that reach each other.
        assert tool.mesh.is_watertight


def test_a_tool_points_along_its_flange(arm):
    tool = tools()[0]
    pose = arm.robot.frame_pose("lower", np.array([0.4, 0.9, -1.2]))
    for axis, column in (("z", 2), ("x", 0)):
        placed = on_flange(tool, pose, axis)
        along = (placed.vertices - pose[:3, 3]) @ pose[:3, column]
        np.testing.assert_allclose(along, tool.mesh.vertices[:, 2], atol=1e-12)
