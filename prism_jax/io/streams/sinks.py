"""Where completed frames go: a folder of PLY files, or an MCAP file."""

import pathlib
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from prism_jax.io.arrays import Fields
from prism_jax.io.atomic import make_output_dir, write_bytes
from prism_jax.io.errors import StrPath
from prism_jax.io.ply import ply_bytes
from prism_jax.io.streams.mcap_output import McapOutput, cloud_message

TOPIC = "/completed"  # of the clouds in an MCAP file


class Labelled(NamedTuple):
    """A completed frame as it is written, with the labels of PLY files."""

    number: int
    timestamp: int
    points: Float[np.ndarray, "M 3"]
    label: UInt8[np.ndarray, " M"]
    frame_id: str = ""  # of the points; "" where nothing tells it
    fields: Fields | None = None  # of the measured points, which come first


@runtime_checkable
class Sink(Protocol):
    """Takes frames one after the other."""

    def write(self, frame: Any) -> None:
        """Keeps or shows a frame: one that is `Labelled`, or an envelope."""

    def close(self) -> None:
        """Ends what was written. Called once, also where the stream was broken off."""


class PlyFolder:
    """A PLY file for each frame, named by its number in the recording, each whole."""

    def __init__(self, path: StrPath):
        self.path = make_output_dir(path)

    def write(self, frame: Labelled) -> None:
        cloud = ply_bytes(frame.points, frame.label, fields=frame.fields)
        write_bytes(self.path / f"{frame.number:06d}.ply", cloud)

    def close(self) -> None:
        pass


class McapSink:
    """PointCloud2 messages on `TOPIC`, with a `label`: 0 observed, 1 completed,
    2 of a known robot's surface; and with the fields of the input."""

    def __init__(self, path: StrPath):
        make_output_dir(pathlib.Path(path).parent)
        self._output = McapOutput(path)

    def write(self, frame: Labelled) -> None:
        named = frame.frame_id or "sensor"
        given = frame.points, frame.timestamp, named, frame.label, frame.fields
        kind = "sensor_msgs/msg/PointCloud2"
        self._output.write(TOPIC, kind, frame.timestamp, cloud_message(*given))

    def close(self) -> None:
        self._output.close()


def open_sink(path: StrPath) -> Sink:
    """An MCAP file where the name ends in .mcap, else a folder of PLY files."""
    is_mcap = pathlib.Path(path).suffix.lower() == ".mcap"
    return McapSink(path) if is_mcap else PlyFolder(path)
