"""Flags that several commands have."""

from absl import flags

from prism_jax.envelope.robot import ROBOT_MARGIN
from prism_jax.io.streams import Joints


def define_strings(**texts: str) -> None:
    """Flags that are None unless they are set, by their help."""
    for name, text in texts.items():
        flags.DEFINE_string(name, None, text)


def define_completion_flags(density: float) -> None:
    """How scans and frames are completed; `density` is the default of that flag."""
    flags.DEFINE_string(
        "weights",
        "small",
        "Released weights, a name or a file; prism-complete --weights=list prints the "
        "names.",
    )
    flags.DEFINE_string(
        "up",
        None,
        "Up direction in the input frame: x, y, z, -x, -y, -z, three numbers x,y,z, "
        "or auto: the normal of the support plane, else the up direction of the "
        "camera, else z; for a recording, from its first frame. Default: -y for a "
        "depth image in its camera's own axes and a cloud of a recording in an optical "
        "frame; else z.",
    )
    define_strings(
        known="Folder of models (OBJ, STL, PLY, DAE, GLB, links of URDF). An object "
        "that is one of them is completed with it, in its pose. The scan is in metres.",
        known_unit="Unit of the models of --known, unless it is the format's: m, cm, "
        "mm or in.",
    )
    flags.DEFINE_bool(
        "adapt",
        False,
        "Adapt the network to each scan first, as in the paper. Slower, with no "
        "reliable benefit.",
    )
    flags.DEFINE_float(
        "density",
        density,
        "Density of added points relative to measured ones, where the network "
        "predicts a surface; 0 keeps the predicted points as they are.",
        lower_bound=0.0,
    )
    flags.DEFINE_enum(
        "background",
        "unknown",
        ["unknown", "empty"],
        "empty: the sensor saw nothing else nearby, so no points are added there.",
    )


def define_recording_flags() -> None:
    """How recordings are read, and a robot in them that is known."""
    define_strings(
        topic="Topic or sensor to read, if the recording has several.",
        urdf="The robot, if known: URDF or xacro.",
        joints="Joint positions of the robot: a .json file, or a JointState topic of "
        "the recording. Default: the positions recorded with each frame.",
        base='JSON with the robot base pose in the frame of the points ("base", 4x4). '
        "Default: the pose given with the joints; in prism-stream, else the identity.",
    )
    flags.DEFINE_enum(
        "pace",
        "max",
        ["max", "sensor"],
        "max: as fast as possible. sensor: at the recorded rate; late frames are "
        "dropped.",
    )
    flags.DEFINE_float(
        "robot_margin",
        ROBOT_MARGIN,
        "Points within so many metres of the robot are its own.",
        0.0,
    )
    flags.DEFINE_float(
        "robot_speed",
        Joints().speed,
        "Metres a second of the robot's fastest point. Between two samples of its "
        "joint positions it may move by --robot_margin.",
        1e-3,
    )


def define_max_points(default: int) -> None:
    """The limit of what is read."""
    flags.DEFINE_integer(
        "max_points",
        default,
        "Files with more points or pixels are rejected before they are read.",
        lower_bound=1,
    )
