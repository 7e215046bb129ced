"""Simulated recordings of a robot cell, as a user has them: MCAP files of ROS 2."""

import os
import pathlib
from collections.abc import Iterable, Iterator

import numpy as np

from experiments.simulation.recorder import write_frame
from prism_jax.data.recordings import DEPTH_SCALE, Frame
from prism_jax.io.streams.mcap_output import (
    McapOutput,
    camera_message,
    depth_message,
    joints_message,
)

START = 1_700_000_000_000_000_000  # nanoseconds of the first frame: some day in 2023

DEPTH_TOPIC = "/camera/depth/image_rect_raw"
INFO_TOPIC = "/camera/depth/camera_info"
JOINTS_TOPIC = "/joint_states"


def record(
    path: str | os.PathLike, frames: Iterable[Frame], rate: float = 10.0
) -> pathlib.Path:
    """Writes frames as a camera's driver and a robot's record them (`write_mcap`).

    Beside the file, in a folder of its name that is returned, lies what a user would
    not have: the frames in the layout of `prism_jax.data.recordings`, with the ground
    truth.
    """
    beside = pathlib.Path(path).with_suffix("")

    def kept() -> Iterator[Frame]:
        for number, frame in enumerate(frames):
            write_frame(beside / "000", number, frame)
            yield frame

    write_mcap(path, kept(), rate)
    return beside


def write_mcap(
    path: str | os.PathLike, frames: Iterable[Frame], rate: float = 10.0
) -> None:
    """Writes what sensors measure of frames as an MCAP file of ROS 2, whole or not:
    depth in millimetres as 16UC1, CameraInfo, and the joints' positions, ``rate`` a
    second."""
    output = McapOutput(path)
    for number, frame in enumerate(frames):
        time = START + round(number * 1e9 / rate)
        counts = np.rint(frame.depth * (1e3 * DEPTH_SCALE)).astype(np.uint16)
        if frame.joints is not None:
            # Before the image of the same time, as robots tell theirs without delay.
            joints = joints_message(frame.joints["positions"], time)
            output.write(JOINTS_TOPIC, "sensor_msgs/msg/JointState", time, joints)
        camera = camera_message(frame.camera, time)
        output.write(INFO_TOPIC, "sensor_msgs/msg/CameraInfo", time, camera)
        image = depth_message(counts, time)
        output.write(DEPTH_TOPIC, "sensor_msgs/msg/Image", time, image)
    output.close()
