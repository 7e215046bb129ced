"""Which format a recording has, by its name."""

import pathlib
import re
from collections.abc import Sequence

from prism_jax.geometry.camera import Camera
from prism_jax.io.depth import read_camera
from prism_jax.io.errors import InputError, StrPath, to_stderr, unreadable
from prism_jax.io.streams.bag import BagFile
from prism_jax.io.streams.db3 import Db3File
from prism_jax.io.streams.folders import CloudFolder, folder_kind, natural
from prism_jax.io.streams.frame import Joints, Stream, Tell
from prism_jax.io.streams.mcap import McapFile
from prism_jax.io.streams.ouster import OusterStream
from prism_jax.io.streams.ros import RosStream

MESSAGES = {".bag": BagFile, ".db3": Db3File, ".mcap": McapFile}
Pinhole = Camera | str | None  # a camera, its JSON file, or the topic of its CameraInfo
OUSTER = (".pcap", ".osf")
SUFFIXES = (*MESSAGES, *OUSTER)


def open_stream(
    path: StrPath,
    topic: str | None = None,
    camera: Pinhole = None,
    tell: Tell | None = None,
    joints: Joints | None = None,
) -> Stream:
    """The frames of a recording: a `.bag` of ROS 1, a `.db3` or `.mcap` of ROS 2, a
    folder of them, an Ouster's `.pcap` or `.osf`, a folder of clouds or depth images,
    or one of recordings (`prism_jax.data.recordings`), of TUM RGB-D or of 7-Scenes.

    If several topics have frames, `topic` chooses; an InputError lists them. A `camera`
    replaces the CameraInfo of depth images, and says where the sensor of clouds stood;
    it may be a JSON file's name. A topic's name takes its CameraInfo for depth images.
    `tell` gets a line for each kind of oddity, by default on stderr. Without `joints`
    frames have no joint positions.
    """
    stream = _opened(pathlib.Path(path), topic, camera, tell)
    if joints is not None:
        stream.take_joints(joints)
    return stream


def is_stream(path: StrPath) -> bool:
    """Whether a name is a recording's and no scan's: a folder, or by its suffix."""
    place = pathlib.Path(path)
    return place.is_dir() or _named(place).suffix in SUFFIXES


def _opened(
    path: pathlib.Path, topic: str | None, camera: Pinhole, tell: Tell | None
) -> Stream:
    camera_file = None
    if isinstance(camera, str) and pathlib.Path(camera).is_file():
        camera_file = pathlib.Path(camera)
        camera = read_camera(camera_file, tell or to_stderr)
    try:
        files = [p for p in path.iterdir() if _named(p).suffix in MESSAGES]
    except NotADirectoryError:
        files = [path] if _named(path).suffix in MESSAGES else []
    except OSError as error:
        raise unreadable(path, error) from None
    for place in files or [path]:
        if not place.is_file() and not place.is_dir():  # a pipe would not be opened
            raise InputError(place, "not a file", "give a file or a folder")
    if files:
        _check_parts(path, files)
        parts = [MESSAGES[_named(p).suffix](p) for p in sorted(files, key=natural)]
        return RosStream(path, parts, topic, camera, tell)
    if path.is_dir():
        kind = folder_kind(path)
    elif _named(path).suffix in OUSTER:
        kind = OusterStream
    else:
        fault = f"suffix {path.suffix.lower()!r} is not a recording format"
        raise InputError(path, fault, f"use a folder or one of {' '.join(SUFFIXES)}")
    if isinstance(camera, str):
        fault = f"no file {camera}, and no CameraInfo in this recording"
        raise InputError("--camera", fault, "give a JSON file")
    stream = kind(path, topic, tell)
    stream.camera = camera
    if isinstance(stream, CloudFolder):
        stream.camera_file = camera_file
    return stream


def _named(path: pathlib.Path) -> pathlib.PurePath:
    """What a recording is called, packed or still open as it may be."""
    name = re.sub(r"\.zstd$|(?<=\.bag)\.active$", "", path.name.lower())
    return pathlib.PurePath(name)


def _check_parts(path: pathlib.Path, files: Sequence[pathlib.Path]) -> None:
    """Refuses files that are not the parts of one recording: named alike but for their
    number, and in ROS 1 their time, or listed by the folder's metadata."""
    about, stems = path / "metadata.yaml", [_named(p).stem for p in files]
    text = about.read_text(errors="replace") if about.is_file() else ""
    listed = {line.strip("- '\"").rpartition("/")[2] for line in text.splitlines()}
    alike = {re.sub(r"(\d{4}(-\d\d){5})?_\d+$", "", stem) for stem in stems}
    numbers = {stem.rpartition("_")[2] for stem in stems}
    if len(alike) == 1 and len(numbers) == len(files):
        return
    if not {p.name for p in files} <= listed:
        names = ", ".join(p.name for p in files)
        raise InputError(path, f"several recordings: {names}", "give one of them")
