"""Which format a recording has, by its name."""

import os
import pathlib
from collections.abc import Callable, Sequence

from prism_jax.io.errors import InputError
from prism_jax.io.streams.bag import BagFile
from prism_jax.io.streams.db3 import Db3File
from prism_jax.io.streams.folders import (
    CloudFolder,
    RecordedFrames,
    is_recordings,
    natural,
)
from prism_jax.io.streams.frame import Stream, Tell
from prism_jax.io.streams.mcap import McapFile
from prism_jax.io.streams.messages import MessageFile
from prism_jax.io.streams.ouster import OusterStream
from prism_jax.io.streams.ros import RosStream

MESSAGES: dict[str, Callable[[pathlib.Path], MessageFile]] = {
    ".bag": BagFile,
    ".db3": Db3File,
    ".mcap": McapFile,
}
OUSTER = (".pcap", ".osf")
SUFFIXES = (*MESSAGES, *OUSTER)


def open_stream(
    path: str | os.PathLike, topic: str | None = None, tell: Tell | None = None
) -> Stream:
    """The frames of a recording.

    A `.bag` of ROS 1, a `.db3` or `.mcap` of ROS 2, a ROS 2 bag's folder of them, an
    Ouster's `.pcap` or `.osf`, a folder of clouds or depth images, or one of recordings
    (`prism_jax.data.recordings`). If several topics have frames, ``topic`` chooses; an
    InputError lists them. ``tell`` gets a line for each kind of oddity; by default they
    go to stderr. What cannot be read at all, and a missing package, raise InputError.
    """
    place = pathlib.Path(path)
    suffix = place.suffix.lower()
    try:
        if place.is_dir():
            parts = [p for p in place.iterdir() if p.suffix.lower() in MESSAGES]
            if parts:
                return RosStream(path, _message_files(parts), topic, tell)
            kind = RecordedFrames if is_recordings(place) else CloudFolder
            return kind(path, topic, tell)
    except OSError as error:
        fault = f"cannot be read ({error.strerror})"
        raise InputError(path, fault, "check its permissions") from None
    if not place.exists():
        raise InputError(path, "no such file or folder", "check the path")
    if suffix in MESSAGES:
        return RosStream(path, _message_files([place]), topic, tell)
    if suffix in OUSTER:
        return OusterStream(path, topic, tell)
    remedy = f"name a folder or a file of {' '.join(SUFFIXES)}"
    raise InputError(path, f"has the suffix {suffix!r}, no recording's", remedy)


def _message_files(paths: Sequence[pathlib.Path]) -> list[MessageFile]:
    """In the order in which a recording was split."""
    return [MESSAGES[p.suffix.lower()](p) for p in sorted(paths, key=natural)]
