"""Robots that are damaged, or larger than they can be."""

import numpy as np
import pytest

from prism_jax.io.errors import InputError
from prism_jax.robots.urdf import Linkage
from tests.experiments.simulation.roboarm import conftest as boxes

ELBOW = boxes.joint("elbow", "upper", "lower", boxes.UPPER, "0 1 0")
BOX = '<box size="0.16 0.16 0.1"/>'
MESH = '<mesh filename="{}"/>'


def changed(folder, old, new):
    assert old in boxes.URDF
    path = folder / "robot.urdf"
    path.write_text(boxes.URDF.replace(old, new, 1))
    return path


def mimic(joint, more=""):
    return ELBOW.replace("<limit", f'<mimic joint="{joint}" {more}/><limit')


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('axis xyz="0 0 1"', 'axis xyz="0 0 0"', "zero or negative"),
        ('axis xyz="0 0 1"', 'axis xyz="nan 0 1"', "not 3 finite"),
        ('origin xyz="0 0 0.1"', 'origin xyz="1"', "not 3 finite"),
        (BOX, '<box size="0.1 -1 0.1"/>', "zero or negative"),
        (BOX, '<sphere radius="nan"/>', "not 1 finite"),
        (BOX, '<mesh filename="a.stl" scale="1 0 1"/>', "zero or negative"),
        (BOX, MESH.format("a" * 300 + ".stl"), "no such mesh"),
        (BOX, "<x/>" * 10_000, "over 10,000 elements"),
        ("revolute", "floating", "'yaw' is 'floating', not revolute"),
        (ELBOW, mimic("elbow"), "'elbow' mimics itself"),
        (ELBOW, mimic("neck"), "'elbow' mimics itself, or no joint"),
        ('<link name="lower">', '<link name="upper">', "two of its links"),
        ("<robot", "<!DOCTYPE r []><robot", "XML entities"),
        ("</robot>", "", "not XML"),
    ],
)
def test_what_would_pass_for_something_else_is_named(tmp_path, old, new, told):
    with pytest.raises(InputError, match=told):
        Linkage(changed(tmp_path, old, new))


def test_a_mimic_of_a_mimic_is_followed_to_the_end(tmp_path):
    """And an axis of any length says where to."""
    wrist = boxes.joint("wrist", "lower", "hand", 0.0, "0 0 5", "prismatic")
    wrist = wrist.replace("<limit", '<mimic joint="elbow" multiplier="3"/><limit')
    elbow = mimic("shoulder", 'multiplier="-0.5" offset="0.1"')
    hand = boxes.link("lower").replace("lower", "hand")
    robot = Linkage(changed(tmp_path, ELBOW, elbow + hand + wrist))
    assert robot.joints == ("yaw", "shoulder")
    lower, moved = robot.link_poses(np.array([[0.0, 0.8]]))[0, -2:]
    along = lower[:3, :3].T @ (moved - lower)[:3, 3]
    np.testing.assert_allclose(along, [0, 0, 3 * (0.1 - 0.5 * 0.8)], atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("obj", "v 0 0 nan\nv 0 1 0\nv 1 0 0\nf 1 2 3"),
        ("obj", "v 0 0 1e300\nv 0 1 0\nv 1 0 0\nf 1 2 3"),
        ("obj", "v 0 0 0\nv 0 1 0\nv 1 0 0\nf 1 2 9"),
        ("dae", "<instance_node/>" * 17),
        ("stl", "solid"),
    ],
)
def test_a_mesh_with_corners_that_are_none_is_refused(tmp_path, kind, data):
    (tmp_path / f"part.{kind}").write_text(data)
    with pytest.raises(InputError, match=f"part.{kind}: not a readable mesh"):
        Linkage(changed(tmp_path, BOX, MESH.format(f"part.{kind}")))
