"""Writes MCAP files of ROS 2 messages, whole or not at all."""

import io
import os
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from prism_jax.io.arrays import Fields
from prism_jax.io.atomic import aside, check_targets
from prism_jax.io.errors import StrPath, require, unwritable
from prism_jax.io.ply import of_first
from prism_jax.io.streams.packed import EXTRA

_STAMP, _HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
NUMBERS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""PointField's types, which it counts from 1."""

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
    frame_id: str,
    labels: UInt8[np.ndarray, " N"],
    fields: Fields | None = None,
) -> Maker:
    """A PointCloud2 in the points' own precision, with a `label` of each, and of the
    first ones the `fields`, as `of_first` has them."""
    columns = {**dict(zip("xyz", points.T, strict=True)), "label": labels}
    columns |= of_first(fields or {}, len(points), columns)
    kinds = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    rows: Any = np.zeros(len(points), np.dtype(kinds, align=True))
    for name, column in columns.items():
        rows[name] = column
    numbers = {name: NUMBERS.index(kind.str[1:]) + 1 for name, kind in kinds}

    def make(types: Any) -> Any:
        field = types["sensor_msgs/msg/PointField"]
        return types["sensor_msgs/msg/PointCloud2"](
            header=header(types, time, frame_id),
            height=1,
            width=len(points),
            fields=[field(n, rows.dtype.fields[n][1], numbers[n], 1) for n in numbers],
            is_bigendian=False,
            point_step=rows.itemsize,
            row_step=rows.nbytes,
            data=rows.view(np.uint8),
            is_dense=True,
        )

    return make
