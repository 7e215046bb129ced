"""Frames from ROS messages: PointCloud2, or depth Images with their CameraInfo."""

import contextlib
import dataclasses
import functools
import posixpath
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from prism_jax.geometry.camera import Camera
from prism_jax.io.arrays import Fields, stack_columns
from prism_jax.io.clouds import measured
from prism_jax.io.depth import camera_from_dict
from prism_jax.io.errors import InputError, StrPath, require
from prism_jax.io.files import MAX_POINTS, check_count
from prism_jax.io.ply import NUMBERS
from prism_jax.io.streams.frame import Frame, Joints, Stream, Tell, chosen_topic
from prism_jax.io.streams.joints import PlacedFrames
from prism_jax.io.streams.messages import EXTRA, CutError, MessageFile, Unpacker

CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
INFO = "sensor_msgs/msg/CameraInfo"
JOINTS = "sensor_msgs/msg/JointState"

DEPTH = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}
"""Encodings of depth images: the type of a pixel, and metres a count (REP 118)."""


class RosStream(Stream):
    """The frames of one topic in one recording, which may be split into several files.

    The CameraInfo beside a depth image gives the pinhole, or that of the topic that
    stands for the camera; distortion is not undone. Joint positions are interpolated.
    """

    def __init__(
        self,
        path: StrPath,
        files: Sequence[MessageFile],
        topic: str | None = None,
        camera: Camera | str | None = None,
        tell: Tell | None = None,
    ):
        super().__init__(path, tell)
        _readers()
        info = camera if isinstance(camera, str) else None
        self.camera = None if isinstance(camera, str) else camera
        self._files = files
        self._kinds: dict[str, tuple[str, str]] = {}  # with encodings, by topic
        self._counts: Counter[str] = Counter()
        for file in files:
            for (name, kind, encoding), count in file.counts().items():
                package, _, own = kind.partition("/")
                kind = kind if "/" in own else f"{package}/msg/{own}"  # as ROS 2 has it
                self._kinds[name] = kind, encoding
                self._counts[name] += count
        self.topic = self._chosen(topic)
        last = "/".join(self.topic.split("/")[-2:])
        self._rectified = re.search("(^|[/_])rect", last) is not None
        self._joints = self._info = None
        # Metres a count, as RealSense's own bags have it.
        option = re.sub("/[^/]*/image/data$", "/option/Depth_Units/value", self.topic)
        known = option != self.topic and option in self._kinds
        self._units = option if known else None
        if self._kinds[self.topic][0] == IMAGE and self.camera is None:
            self._info = self._info_topic(info)
        elif info is not None:
            fault = f"no file {info}, and a CameraInfo does not say where clouds are"
            raise InputError("--camera", fault, "give a JSON file")

    def __len__(self) -> int:
        return self._counts[str(self.topic)]

    def _frames(self) -> Iterator[Frame]:
        camera = self._first_camera() if self._info else self.camera
        unit, topics = None, (self.topic, self._info, self._joints, self._units)
        wanted = {name for name in topics if name is not None}
        placed = PlacedFrames(self.joints or Joints())
        for topic, logged, data in self._messages(wanted):
            try:
                content = self._read(topic, data)
                if topic == self._units:
                    unit = float(content.data)
                    continue
                stamp = content.header.stamp
                # Where nobody filled it in, when it was recorded.
                time = stamp.sec * 1_000_000_000 + stamp.nanosec or logged
                if topic == self._joints:
                    yield from placed.add_positions(_positions(content), time)
                elif topic == self._info:
                    camera = self._pinhole(content, camera)
                else:
                    frame = _frame(content, camera, time, unit)
                    known = self._joints is not None
                    yield from placed.add_frame(frame) if known else [frame]
            except ValueError as error:
                self.remark("damaged", f"skipped a message on {topic}: {error}")
        yield from placed.done(0)

    def _messages(
        self, wanted: Collection[str], told: bool = True
    ) -> Iterator[tuple[str, int, bytes]]:
        """Those of all files. One that is cut ends early, with a remark if `told`."""
        for file in self._files:
            count = 0
            self._unpacker = Unpacker(file.path)
            try:
                for message in file.messages(wanted):
                    count += message[0] == self.topic
                    yield message
            except CutError as error:
                line = f"{file.path.name} is truncated or damaged: {error}"
                line += f"; the {count} complete messages are used"
                if told:
                    self.remark("cut", line)

    def _read(self, topic: str, data: bytes) -> Any:
        """A message's content. Whatever is wrong with it raises ValueError."""
        kind, encoding = self._kinds[topic]
        try:
            return _readers()[encoding](self._unpacker.message(data), kind)
        except Exception as error:  # rosbags lets pass whatever it stumbles over
            raise ValueError(f"not a {kind} ({type(error).__name__})") from None

    def _check_joints(self, joints: Joints) -> None:
        found = self._of_kind(JOINTS)
        if not found:
            super()._check_joints(joints)
        about = found, "joint positions", "--joints"
        self._joints = chosen_topic(self.path, joints.topic, *about)
        self._unknown = f"no joint positions within {joints.gap:g} s around it"

    def _of_kind(self, kind: str) -> list[str]:
        return [name for name, (found, _) in self._kinds.items() if found == kind]

    def _chosen(self, topic: str | None) -> str:
        """The topic that frames are taken from."""
        fitting = self._fitting(topic)
        if fitting:
            return chosen_topic(self.path, topic, fitting, "clouds or depth images")
        if not self._kinds:
            list(self._messages(()))  # tells what is wrong with the files
        fault = "no PointCloud2 or depth Image messages"
        held = ", ".join(f"{name} ({kind})" for name, (kind, _) in self._kinds.items())
        remedy = "record one of them, or aggregate others into a PointCloud2; found "
        remedy += textwrap.shorten(held, 2000, placeholder=" ...") or "nothing"
        raise InputError(self.path, fault, remedy)

    def _fitting(self, topic: str | None) -> list[str]:
        """Topics of the right kind. Of Images the first message tells."""
        known = self._kinds.items()
        kinds = {n: kind for n, (kind, encoding) in known if encoding in _readers()}
        images = {name for name, kind in kinds.items() if kind == IMAGE}
        if topic is not None:
            images &= {topic}
        depths: set[str] = set()
        for name, _, data in self._messages(frozenset(images), False) if images else ():
            if name in images:
                images.remove(name)
                with contextlib.suppress(ValueError):
                    encoding = self._read(name, data).encoding
                    # Infrared is mono16, too.
                    told = topic is not None or "depth" in name.lower()
                    if encoding in DEPTH and (told or encoding != "mono16"):
                        depths.add(name)
            if not images:
                break
        return [n for n, kind in kinds.items() if kind == CLOUD or n in depths]

    def _info_topic(self, asked: str | None) -> str:
        """The topic of the camera's intrinsics: the one asked for, or beside it."""
        topic, infos = str(self.topic), self._of_kind(INFO)
        beside = posixpath.join(posixpath.dirname(topic), "camera_info")
        own = re.sub("/image/data$", "/info/camera_info", topic)  # RealSense's bags
        beside = own if own in infos else beside
        found = beside if asked is None else asked
        if found in infos:
            return found
        fault = f"depth images on {topic} but no CameraInfo on {found}"
        remedy = f"record {beside} too, or set --camera to a JSON file"
        if infos:
            remedy = f"set --camera to one of {', '.join(infos)}, or to a JSON file"
        raise InputError(self.path, fault, remedy)

    def _pinhole(self, content: Any, before: Camera | None = None) -> Camera:
        """The pinhole of a CameraInfo, of rectified images that of their projection;
        ValueError if it is none. What is odd, also beside the one before, is told."""
        raw, projection = (_either(content, name) for name in "kp")
        fx, _, cx, _, fy, cy = map(float, raw[:6])
        if self._rectified and np.any(projection):
            fx, _, cx, _, _, fy, cy = map(float, projection[:7])
        size = {"width": content.width, "height": content.height}
        camera = camera_from_dict({**size, "fx": fx, "fy": fy, "cx": cx, "cy": cy})
        if np.any(_either(content, "d")) and not self._rectified:
            line = f"{self._info} has lens distortion, which is ignored"
            self.remark("distortion", line)
        cameras = before or camera, camera
        known = [[c.width, c.height, *np.ravel(c.intrinsics)] for c in cameras]
        with np.errstate(over="ignore"):
            same = np.allclose(*known, rtol=1e-6)
        if not same:
            line = f"{self._info} has another size or other intrinsics than before"
            self.remark("camera", f"{line}; used from then on")
        return camera

    def _first_camera(self) -> Camera:
        for topic, _, data in self._messages({str(self._info)}, False):
            with contextlib.suppress(ValueError):
                return self._pinhole(self._read(topic, data))
        fault = f"no readable CameraInfo on {self._info}"
        raise InputError(self.path, fault, "record it again")


@functools.cache
def _readers() -> dict[str, Callable[[bytes, str], Any]]:
    """What reads messages of the standard types, which all releases share, by how they
    are encoded; CameraInfo's fields have other names in ROS 1."""
    types = require("rosbags.typesys", EXTRA)
    return {
        "ros1": types.get_typestore(types.Stores.ROS1_NOETIC).deserialize_ros1,
        "cdr": types.get_typestore(types.Stores.ROS2_HUMBLE).deserialize_cdr,
    }


def _either(content: Any, name: str) -> Float[np.ndarray, " N"]:
    """A field of a CameraInfo, which ROS 1 has in capitals."""
    named = name if hasattr(content, name) else name.upper()
    return np.asarray(getattr(content, named), np.float64)


def _positions(content: Any) -> dict[str, float]:
    """The finite ones of a JointState; ValueError if it is not as it says."""
    names, positions = list(content.name), np.asarray(content.position, np.float64)
    if len(names) != len(positions):
        raise ValueError(f"{len(names)} joints have {len(positions)} positions")
    told = zip(names, positions.tolist(), strict=True)
    return {name: position for name, position in told if np.isfinite(position)}


def _frame(content: Any, camera: Camera | None, time: int, unit: float | None) -> Frame:
    """The frame of a cloud, or of a depth image by its camera, a count of integers
    being the unit, if that is known; ValueError if it is not as it says."""
    if hasattr(content, "fields"):
        frame = _cloud(content, time)
    else:
        assert camera is not None
        pixels, scale = _depth(content)
        if pixels.shape != (camera.height, camera.width):
            sizes = f"{pixels.shape[1]}x{pixels.shape[0]}, camera is "
            raise ValueError(f"image is {sizes}{camera.width}x{camera.height}")
        scale = unit or scale if pixels.dtype.kind == "u" else scale
        frame = Frame.of_depth(pixels, camera, time, scale)
    return dataclasses.replace(frame, frame_id=content.header.frame_id)


def _depth(content: Any) -> tuple[Num[np.ndarray, "H W"], float]:
    """The pixels of a depth Image, and metres a count; ValueError if it is not as it
    says."""
    if content.encoding not in DEPTH:
        raise ValueError(f"image encoding {content.encoding} is not supported")
    kind, scale = DEPTH[content.encoding]
    kind = np.dtype((">" if content.is_bigendian else "<") + kind)
    return _rows(content, content.step, kind).astype(kind.newbyteorder("=")), scale


def _cloud(content: Any, time: int) -> Frame:
    """The frame of a PointCloud2; ValueError if it is not as it says."""
    names = [field.name for field in content.fields]
    if not {*"xyz"} <= {*names}:
        raise ValueError(f"points have {', '.join(names) or 'nothing'}, not x y z")
    places = _places(content)
    floats = [axis for axis in "xyz" if axis in places and places[axis][0].kind == "f"]
    if len(floats) < 3:
        raise ValueError("point layout differs from the header")
    names = [*floats, *(name for name in places if name not in floats)]
    kinds, offsets = zip(*(places[name] for name in names), strict=True)
    layout: Any = {"names": names, "formats": kinds, "offsets": offsets}
    layout = np.dtype(layout | {"itemsize": content.point_step})
    row = content.row_step or layout.itemsize * content.width  # which some leave at 0
    rows = _rows(content, row, layout).ravel()
    fields: Fields = {}
    points = stack_columns((rows[name] for name in names), kinds, names[3:], fields)
    kept, notes = measured(points, fields=fields)
    num_lost = len(points) - len(kept)
    return Frame(kept, time, num_not_finite=num_lost, notes=notes, fields=fields)


def _places(content: Any) -> dict[str, tuple[np.dtype, int]]:
    """The type of each field of one number in a PointCloud2, and where in a point it
    starts; without padding, and without what does not fit into a point."""
    order, found = ">" if content.is_bigendian else "<", {}
    for field in content.fields:
        known = field.name not in ("", "_") and 1 <= field.datatype <= len(NUMBERS)
        if known and field.count < 2:
            kind = np.dtype(order + [*NUMBERS][field.datatype - 1])
            if field.offset + kind.itemsize <= content.point_step:
                found[field.name] = kind, field.offset
    return found


def _rows(content: Any, row: int, kind: np.dtype) -> np.ndarray:
    """What an Image or a PointCloud2 has in rows of so many bytes; ValueError if these
    are not there."""
    height, width = content.height, content.width * kind.itemsize
    claimed, held = row * height, len(content.data)
    check_count(height * content.width, MAX_POINTS)
    if held < claimed:
        raise ValueError(f"{claimed:,} bytes declared, {held:,} found")
    if row < width:
        raise ValueError("rows are shorter than declared")
    rows = np.asarray(content.data, np.uint8)[:claimed].reshape(height, row)
    return np.ascontiguousarray(rows[:, :width]).view(kind)
