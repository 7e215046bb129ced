"""Simulated recordings of a robot cell, as a user has them: MCAP files of ROS 2."""

import os
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from experiments.simulation.recorder import write_frame
from prism_jax.data.recordings import DEPTH_SCALE, RecordedFrame
from prism_jax.geometry.camera import Camera
from prism_jax.io.streams.mcap_output import Maker, McapOutput, header

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


def depth_message(counts: np.ndarray, time: int, frame_id: str = "camera") -> Maker:
    """An Image of depth: 16UC1 in millimetres, or 32FC1 in metres."""
    encoding = "16UC1" if counts.dtype == np.uint16 else "32FC1"
    height, width = counts.shape
    rows = np.ascontiguousarray(counts).view(np.uint8).reshape(height, -1)

    def make(types: Any) -> Any:
        return types["sensor_msgs/msg/Image"](
            header=header(types, time, frame_id),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.ravel(),
        )

    return make


def camera_message(camera: Camera, time: int, frame_id: str = "camera") -> Maker:
    """A CameraInfo without distortion."""
    matrix = np.asarray(camera.intrinsics, np.float64)

    def make(types: Any) -> Any:
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

    return make


def joints_message(positions: dict[str, float], time: int) -> Maker:
    """A JointState of positions alone, in radians or metres, by joint."""

    def make(types: Any) -> Any:
        return types["sensor_msgs/msg/JointState"](
            header=header(types, time, ""),
            name=list(positions),
            position=np.array(list(positions.values()), np.float64),
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )

    return make
