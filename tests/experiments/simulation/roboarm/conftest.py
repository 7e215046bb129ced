"""A small robot made of boxes, and settings that make its frames in no time."""

import dataclasses

import pytest

from experiments.simulation.roboarm.models import ArmModel
from experiments.simulation.roboarm.sequences import SURVEY, RoboArmConfig

UPPER, LOWER, SHOULDER = 0.4, 0.3, 0.15
"""Lengths of the two links, and the shoulder's height."""

BOXES = {
    "base": ((0.16, 0.16, 0.1), 0.05),
    "turret": ((0.1, 0.1, 0.06), 0.02),
    "upper": ((0.07, 0.07, UPPER), UPPER / 2),
    "lower": ((0.05, 0.05, LOWER), LOWER / 2),
}
"""Size of each link's box, and how high in the link's frame its centre is."""


def link(name):
    size, height = BOXES[name]
    return (
        f'<link name="{name}"><visual><origin xyz="0 0 {height}"/>'
        f'<geometry><box size="{" ".join(map(str, size))}"/></geometry>'
        "</visual></link>"
    )


def joint(name, parent, child, height, axis, kind="revolute", more=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="0 0 {height}"/><axis xyz="{axis}"/>'
        f'<limit lower="-2" upper="2" effort="1" velocity="1"/>{more}</joint>'
    )


URDF = "".join(
    [
        '<?xml version="1.0"?><robot name="boxes">',
        *map(link, BOXES),
        joint("yaw", "base", "turret", 0.1, "0 0 1"),
        joint("shoulder", "turret", "upper", SHOULDER - 0.1, "0 1 0"),
        joint("elbow", "upper", "lower", UPPER, "0 1 0"),
        "</robot>",
    ]
)


@pytest.fixture(scope="session")
def urdf(tmp_path_factory):
    """Path of an arm that yaws and pitches twice."""
    path = tmp_path_factory.mktemp("robot") / "boxes.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture(scope="session")
def model(urdf):
    return ArmModel("boxes", "test", str(urdf))


@pytest.fixture(scope="session")
def small():
    """Images of 80x60 pixels, 256 points of ground truth, no noise."""
    config = RoboArmConfig()
    survey = dataclasses.replace(SURVEY.exact(), beams=48, columns=384)
    return dataclasses.replace(
        config,
        width=80,
        height=60,
        complete_points=256,
        num_waypoints=3,
        num_stations=6,
        glossy_share=0.0,
        depth_sensor=config.depth_sensor.exact(),
        survey_sensor=survey,
    )
