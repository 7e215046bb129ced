"""Where completed frames go: a folder of PLY files, or an MCAP file of ROS 2."""

import dataclasses
import io
import os
import pathlib
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from prism_jax.io.arrays import Fields
from prism_jax.io.atomic import aside, check_targets, make_output_dir, write_bytes
from prism_jax.io.errors import StrPath, require, unwritable
from prism_jax.io.ply import NUMBERS, of_first, ply_bytes
from prism_jax.io.streams.messages import EXTRA

TOPIC = "/completed"  # of the clouds in an MCAP file
_STAMP, _HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"


@dataclasses.dataclass(frozen=True)
class Labelled:
    """A completed frame as it is written, with the labels of PLY files."""

    number: int  # in the recording
    timestamp: int  # the measurement's, in nanoseconds
    points: Float[np.ndarray, "M 3"]  # the measured ones come first
    label: UInt8[np.ndarray, " M"]
    frame_id: str = ""  # of the points; "" where nothing tells it
    # Of each measured point what else the frame has, as its intensity.
    fields: Fields | None = None


@runtime_checkable
class Sink(Protocol):
    """Takes frames one after the other."""

    def write(self, frame: Any) -> None:
        """Keeps or shows a frame: one that is `Labelled`, or an envelope."""

    def close(self) -> None:
        """Ends what was written. Called once, also where the stream was broken off."""


class PlyFolder(Sink):
    """A PLY file for each frame, named by its number in the recording, each whole."""

    def __init__(self, path: StrPath):
        self.path = make_output_dir(path)

    def write(self, frame: Labelled) -> None:
        cloud = ply_bytes(frame.points, frame.label, fields=frame.fields)
        write_bytes(self.path / f"{frame.number:06d}.ply", cloud)


class McapOutput:
    """An MCAP file that is being written. Each message is on the disk at once. Until
    `close` its name is `aside`: what a killed program leaves there can be read up to
    the last whole message, and an older file of the name is still whole. `types` makes
    messages."""

    def __init__(self, path: StrPath):
        writer = require("mcap.writer", EXTRA)
        types = require("rosbags.typesys", EXTRA)
        self._store = types.get_typestore(types.Stores.ROS2_HUMBLE)
        self.types: Any = self._store.types
        self.path = pathlib.Path(path)
        make_output_dir(self.path.parent)
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

    def add(self, topic: str, time: int, message: Any) -> None:
        """Adds a message to a topic, which has messages of one type."""
        kind = message.__msgtype__
        if topic not in self._channels:
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            schema = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        data = bytes(self._store.serialize_cdr(message, kind))
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


class McapSink(McapOutput):
    """PointCloud2 messages on `TOPIC` in the points' own precision, with a `label`: 0
    observed, 1 completed, 2 of a known robot's surface; and with the fields of the
    input, as `of_first` has them."""

    def write(self, frame: Labelled) -> None:
        points, label = frame.points, frame.label
        columns = {**dict(zip("xyz", points.T, strict=True)), "label": label}
        columns |= of_first(frame.fields or {}, len(points), columns)
        kinds = [(name, f"<{column.dtype.str[1:]}") for name, column in columns.items()]
        rows: Any = np.zeros(len(points), np.dtype(kinds, align=True))
        for name, column in columns.items():
            rows[name] = column
        field, places = self.types["sensor_msgs/msg/PointField"], rows.dtype.fields
        codes = {f"<{kind}": code for code, kind in enumerate(NUMBERS, 1)}
        message = self.types["sensor_msgs/msg/PointCloud2"](
            header=header(self.types, frame.timestamp, frame.frame_id or "sensor"),
            height=1,
            width=len(points),
            fields=[field(n, places[n][1], codes[kind], 1) for n, kind in kinds],
            is_bigendian=False,
            point_step=rows.itemsize,
            row_step=rows.nbytes,
            data=rows.view(np.uint8),
            is_dense=True,
        )
        self.add(TOPIC, frame.timestamp, message)


def header(types: Any, time: int, frame_id: str) -> Any:
    """A message's header, of a time in nanoseconds. One that it cannot hold is only
    that of the log: readers take it where there is none in the header."""
    seconds, nanoseconds = divmod(time, 1_000_000_000)
    if not 0 <= seconds < 2**31:
        seconds, nanoseconds = 0, 0
    return types[_HEADER](types[_STAMP](seconds, nanoseconds), frame_id)


def open_sink(path: StrPath) -> Sink:
    """An MCAP file where the name ends in .mcap, else a folder of PLY files."""
    is_mcap = pathlib.Path(path).suffix.lower() == ".mcap"
    return McapSink(path) if is_mcap else PlyFolder(path)
