"""Writes MCAP files of ROS 2 messages, whole or not at all."""

import io
import os
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from prism_jax.io.atomic import aside, check_targets
from prism_jax.io.errors import StrPath, require, unwritable
from prism_jax.io.streams.packed import EXTRA

_STAMP, _HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
_UINT8, _FLOATS = 2, {4: 7, 8: 8}  # PointField's numbers of types
Maker = Callable[..., Any]
"""Of a message: takes the makers of all types, by name, and gives one."""


class McapOutput:
    """An MCAP file that is being written. Each message is on the disk at once. Until
    `close` its name is `aside`: what a killed program leaves there can be read up to
    the last whole message, and an older file of the name is still whole."""

    def __init__(self, path: StrPath):
        writer = require("mcap.writer", EXTRA)
        types = require("rosbags.typesys", EXTRA)
        self._store = types.get_typestore(types.Stores.ROS2_HUMBLE)
        self.path = pathlib.Path(path)
        check_targets([self.path])
        self.part = aside(self.path, ".part.mcap")
        try:
            self._file = io.BufferedWriter(io.FileIO(self.part, "x"))
            # A chunk for each message, so that none waits for the next.
            self._writer = writer.Writer(self._file, chunk_size=1)
            self._writer.start("ros2", "prism_jax")
            self._file.flush()
        except OSError as error:
            raise unwritable(self.path, error) from None
        self._channels: dict[str, int] = {}

    def write(self, topic: str, kind: str, time: int, make: Maker) -> None:
        """Adds what `make` makes of the types as a message of that type."""
        if topic not in self._channels:
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            schema = self._writer.register_schema(kind, "ros2msg", text.encode())
            channel = self._writer.register_channel(topic, "cdr", schema)
            self._channels[topic] = channel
        data = bytes(self._store.serialize_cdr(make(self._store.types), kind))
        time = min(max(time, 0), 2**64 - 1)  # as far as the log's clock goes
        try:
            self._writer.add_message(self._channels[topic], time, data, time)
            self._file.flush()
        except OSError as error:
            raise unwritable(self.path, error) from None

    def close(self) -> None:
        """Ends the file and gives it its name; without a message, leaves none."""
        if self._file.closed:
            return
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            if self._channels:
                os.replace(self.part, self.path)
            else:
                self.part.unlink()
        except OSError as error:
            raise unwritable(self.path, error) from None


def header(types: Any, time: int, frame_id: str) -> Any:
    """A message's header, of a time in nanoseconds. One that it cannot hold is only
    that of the log: readers take it where there is none in the header."""
    seconds, nanoseconds = divmod(time, 1_000_000_000)
    if not 0 <= seconds < 2**31:
        seconds, nanoseconds = 0, 0
    return types[_HEADER](types[_STAMP](seconds, nanoseconds), frame_id)


def cloud_message(
    points: Float[np.ndarray, "N 3"],
    time: int,
    frame_id: str = "sensor",
    labels: UInt8[np.ndarray, " N"] | None = None,
) -> Maker:
    """A PointCloud2 in the points' own precision, with a `label` of each if given."""
    size = 8 if points.dtype == np.float64 else 4
    fields = [(axis, place * size, _FLOATS[size]) for place, axis in enumerate("xyz")]
    step = 3 * size if labels is None else 4 * size
    rows = np.zeros((len(points), step), np.uint8)
    positions = np.ascontiguousarray(points, f"<f{size}")
    rows[:, : 3 * size] = positions.view(np.uint8).reshape(len(points), 3 * size)
    if labels is not None:
        fields.append(("label", 3 * size, _UINT8))
        rows[:, 3 * size] = labels

    def make(types: Any) -> Any:
        field = types["sensor_msgs/msg/PointField"]
        return types["sensor_msgs/msg/PointCloud2"](
            header=header(types, time, frame_id),
            height=1,
            width=len(points),
            fields=[field(name, offset, kind, 1) for name, offset, kind in fields],
            is_bigendian=False,
            point_step=step,
            row_step=step * len(points),
            data=rows.ravel(),
            is_dense=True,
        )

    return make
