"""Simulated recordings of a robot cell, as a user has them: MCAP files of ROS 2."""

import os
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from experiments.simulation.recorder import write_frame
from prism_jax.data.recordings import DEPTH_SCALE, RecordedFrame
from prism_jax.geometry.camera import Camera
from prism_jax.io.streams.sinks import McapOutput, header

START = 1_700_000_000_000_000_000  # nanoseconds of the first frame: some day in 2023

DEPTH_TOPIC = "/camera/depth/image_rect_raw"
INFO_TOPIC = "/camera/depth/camera_info"
JOINTS_TOPIC = "/joint_states"


def record(
    path: str | os.PathLike, frames: Iterable[RecordedFrame], rate: float = 10.0
) -> pathlib.Path:
    """Writes frames as a camera's driver and a robot's record them (`write_mcap`).

    Beside the file, in a folder of its name that is returned, lies what a user would
    not have: the frames in the layout of `prism_jax.data.recordings`, with the ground
    truth.
    """
    beside = pathlib.Path(path).with_suffix("")

    def kept() -> Iterator[RecordedFrame]:
        for number, frame in enumerate(frames):
            write_frame(beside / "000", number, frame)
            yield frame

    write_mcap(path, kept(), rate)
    return beside


def write_mcap(
    path: str | os.PathLike, frames: Iterable[RecordedFrame], rate: float = 10.0
) -> None:
    """Writes what sensors measure of frames as an MCAP file of ROS 2, whole or not:
    depth in millimetres as 16UC1, CameraInfo, and the joints' positions, ``rate`` a
    second."""
    output = McapOutput(path)
    types = output.types
    for number, frame in enumerate(frames):
        time = START + round(number * 1e9 / rate)
        counts = np.rint(frame.depth * (1e3 * DEPTH_SCALE)).astype(np.uint16)
        if frame.joints is not None:
            # Before the image of the same time, as robots tell theirs without delay.
            joints = joints_message(types, frame.joints["positions"], time)
            output.add(JOINTS_TOPIC, time, joints)
        output.add(INFO_TOPIC, time, camera_message(types, frame.camera, time))
        output.add(DEPTH_TOPIC, time, depth_message(types, counts, time))
    output.close()


def depth_message(
    types: Any, counts: np.ndarray, time: int, frame_id: str = "camera"
) -> Any:
    """An Image of depth: 16UC1 in millimetres, or 32FC1 in metres."""
    height, width = counts.shape
    rows = np.ascontiguousarray(counts).view(np.uint8).reshape(height, -1)
    return types["sensor_msgs/msg/Image"](
        header=header(types, time, frame_id),
        height=height,
        width=width,
        encoding="16UC1" if counts.dtype == np.uint16 else "32FC1",
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.ravel(),
    )


def camera_message(
    types: Any, camera: Camera, time: int, frame_id: str = "camera"
) -> Any:
    """A CameraInfo without distortion."""
    matrix = np.asarray(camera.intrinsics, np.float64)
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return types["sensor_msgs/msg/CameraInfo"](
        header=header(types, time, frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def joints_message(types: Any, positions: dict[str, float], time: int) -> Any:
    """A JointState of positions alone, in radians or metres, by joint."""
    return types["sensor_msgs/msg/JointState"](
        header=header(types, time, ""),
        name=list(positions),
        position=np.array(list(positions.values()), np.float64),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )
