"""Which arms stand in which split's cells, and where their URDF files are.

The files come with the PyPI packages `example-robot-data` and `rtb-data` (the extra
`robots`). An arm that belongs to a larger robot is taken off it at the link `root`.
"""

import dataclasses
import os
import pathlib
import re

from prism_jax.io.errors import InputError, choose
from prism_jax.robots.packages import robots_folder

PACKAGE, INDUSTRIAL_PACKAGE = "example-robot-data", "rtb-data"
OWN = "own"
"""The family of the user's arms."""


@dataclasses.dataclass(frozen=True)
class ArmModel:
    """An arm that stands in cells."""

    name: str
    family: str  # its maker's line; none is in two splits
    urdf: str  # URDF or xacro; a relative path is in the package's folder of robots
    # The first link of the arm, which is bolted down by the joint above it; what is not
    # below it is left out. By default the whole robot.
    root: str | None = None
    roll_pitch_yaw: tuple[float, float, float] = (0.0, 0.0, 0.0)  # degrees, of the root
    # Metres between the pedestal and the root's lowest point, for a shoulder whose next
    # link hangs lower.
    spacer: float = 0.0
    # A two-finger gripper is put on this link of an arm without a hand.
    tool_link: str | None = None
    tool_axis: str = "z"  # of that link, along which the gripper points
    licence: str = "its owner's"  # of its meshes
    package: str = PACKAGE


ARMS = {
    "train": (
        ArmModel(
            "tiago",
            "PAL",
            "tiago_description/robots/tiago_no_hand.urdf",
            "arm_1_link",
            spacer=0.12,
            tool_link="wrist_ft_tool_link",
            licence="Apache-2.0",
        ),
        ArmModel(
            "pr2",
            "Willow Garage",
            "pr2_description/urdf/pr2.urdf",
            "r_shoulder_pan_link",
            licence="BSD",
        ),
        ArmModel(
            "tiago_pro",
            "PAL",
            "tiago_pro_description/robots/tiago_pro.urdf",
            "arm_left_1_link",
            licence="Apache-2.0",
        ),
        ArmModel(
            "romeo",
            "Aldebaran",
            "romeo_description/urdf/romeo.urdf",
            "LShoulderPitchLink",
            (0.0, -90.0, 0.0),
            spacer=0.1,
            licence="BSD",
        ),
        ArmModel(
            "talos",
            "PAL",
            "talos_data/robots/talos_left_arm.urdf",
            None,
            (180.0, 0.0, 0.0),
            spacer=0.15,
            licence="Apache-2.0",
        ),
    ),
    "validation": (
        ArmModel(
            "so101",
            "SO-ARM",
            "so_arm_description/urdf/so101.urdf",
            licence="Apache-2.0",
        ),
        ArmModel(
            "centauro",
            "IIT",
            "centauro_description/urdf/centauro.urdf",
            "arm1_1",
            (180.0, 0.0, 0.0),
            spacer=0.15,
            licence="Apache-2.0",
        ),
        ArmModel(
            "so100",
            "SO-ARM",
            "so_arm_description/urdf/so100.urdf",
            licence="Apache-2.0",
        ),
    ),
    "test": (
        ArmModel(
            "panda", "Franka", "panda_description/urdf/panda.urdf", licence="Apache-2.0"
        ),
        ArmModel(
            "ur5",
            "Universal Robots",
            "ur_description/urdf/ur5_gripper.urdf",
            licence="BSD",
        ),
        ArmModel(
            "jaco", "Kinova", "kinova_description/robots/kinova.urdf", licence="BSD"
        ),
        ArmModel(
            "xarm7",
            "UFACTORY",
            "xarm_description/urdf/xarm7.urdf",
            tool_link="link_eef",
            licence="BSD-3-Clause",
        ),
        ArmModel(
            "baxter",
            "Rethink",
            "baxter_description/urdf/baxter.urdf",
            "left_upper_shoulder",
            licence="BSD",
        ),
        ArmModel("z1", "Unitree", "z1_description/urdf/z1.urdf", licence="MPL-2.0"),
        ArmModel(
            "ur10",
            "Universal Robots",
            "ur_description/urdf/ur10_robot.urdf",
            tool_link="ee_link",
            tool_axis="x",
            licence="BSD",
        ),
    ),
}
"""The arms of each split; sequence i has arm `i % len`."""


_KUKA = (
    ("kr3r540", "kuka_kr3/urdf/kr3r540.xacro"),
    ("kr5_arc", "kuka_kr5/urdf/kr5_arc.xacro"),
    ("kr6r700sixx", "kuka_kr6/urdf/kr6r700sixx.xacro"),
    ("kr6r900sixx", "kuka_kr6/urdf/kr6r900sixx.xacro"),
    ("kr10r1100sixx", "kuka_kr10/urdf/kr10r1100sixx.xacro"),
    ("kr16_2", "kuka_kr16/urdf/kr16_2.xacro"),
    ("kr120r2500pro", "kuka_kr120/urdf/kr120r2500pro.xacro"),
    ("kr150_2", "kuka_kr150/urdf/kr150_2.xacro"),
    ("kr210l150", "kuka_kr210/urdf/kr210l150.urdf"),
    ("lbr_iiwa_14_r820", "kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.xacro"),
)
_TROSSEN = ("px100", "rx150", "rx200", "vx300s", "wx250s")

CELL_ARMS = {
    "train": ARMS["train"]
    + tuple(
        ArmModel(
            name,
            "KUKA",
            f"kuka_description/{file}",
            tool_link="tool0",
            licence="Apache-2.0" if name.startswith("lbr") else "BSD",
            package=INDUSTRIAL_PACKAGE,
        )
        for name, file in _KUKA
    ),
    "validation": ARMS["validation"]
    + tuple(
        ArmModel(
            name,
            "Trossen",
            f"trossen_descriptions/urdf/{name}.urdf.xacro",
            licence="BSD-2-Clause",
            package=INDUSTRIAL_PACKAGE,
        )
        for name in _TROSSEN
    ),
}
"""The arms of the varied cells: those of the same split above, and industrial ones."""


def arms_of(split: str) -> tuple[ArmModel, ...]:
    """The arms of a split; an unknown one raises InputError."""
    return ARMS[choose("split", split, ARMS)]


def own_arm(path: str | os.PathLike) -> ArmModel:
    """An arm of the user's, the whole robot of a URDF file, named after the file."""
    path = pathlib.Path(path).absolute()
    name = re.sub(r"[^\w-]", "_", path.stem)
    return ArmModel(name, OWN, str(path))


def urdf_path(model: ArmModel) -> pathlib.Path:
    """The file of an arm; InputError where it is not there."""
    path = pathlib.Path(model.urdf)
    if not path.is_absolute():
        path = robots_folder(model.package) / path
    if not path.is_file():
        raise InputError(path, "no such file", "name the URDF of another robot")
    return path
