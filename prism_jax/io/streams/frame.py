"""What every format of recorded streams gives: frames with their times, and remarks."""

import abc
import dataclasses
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Num

from prism_jax.geometry.camera import Camera
from prism_jax.io.arrays import Fields
from prism_jax.io.depth import measured_depth, points_from_depth
from prism_jax.io.errors import InputError, StrPath, Tell, to_stderr

LATE = 1_000_000  # nanoseconds: clocks that step back by less are not told


class Joints(NamedTuple):
    """Where the joint positions of a robot in a stream come from."""

    # Of the recording's, by default the only one, or what its frames have.
    topic: str | None = None
    # Those of every frame, as a `joints.json` of recordings has them, or None.
    given: Mapping[str, Any] | None = None
    # The robot's pose in the points' frame, 4x4, or None for what `given` or the frames
    # say of it.
    base: Any = None
    # Those of a topic are interpolated between samples at most so many seconds apart.
    # `speed` is that of the robot's fastest point, in metres a second.
    gap: float = 0.12
    speed: float = 0.25
    names: Collection[str] = ()  # joints that a frame must have; by default all seen


@dataclasses.dataclass(frozen=True)
class Frame:
    """One measurement of a sensor, in metres."""

    # The finite ones, in the sensor's frame, or in the world's where the format knows
    # the sensor's pose. There may be none.
    points: Float[np.ndarray, "N 3"]
    timestamp: int  # in nanoseconds, of whatever clock the recording has
    # The pinhole of a depth image, or None. Its pose refers to the frame of the points.
    camera: Camera | None = None
    # A depth image along the camera's z, 0 where there was no return, or None.
    depth: Float[np.ndarray, "H W"] | None = None
    num_not_finite: int = 0  # points that were left out: not finite, or lost returns
    # What was odd in it, a line for each kind of remark.
    notes: Mapping[str, str] = dataclasses.field(default_factory=dict)
    # Of a robot in it, as a `joints.json` of recordings has them, if the stream was
    # asked for them and has some.
    joints: Mapping[str, Any] | None = None
    # What the recording calls the points' frame; "" if nothing, or if the camera's pose
    # puts them into another.
    frame_id: str = ""
    # Of each point of a cloud what else was recorded, such as its intensity.
    fields: Fields = dataclasses.field(default_factory=dict)

    @classmethod
    def of_depth(
        cls,
        pixels: Num[np.ndarray, "H W"],
        camera: Camera,
        timestamp: int,
        scale: float = 1.0,
    ) -> "Frame":
        """The frame of a depth image of `scale` metres a count. Which pixels are no
        return is up to `measured_depth`. Numbers that make points which are not finite
        raise InputError."""
        with np.errstate(all="ignore"):
            depth, num_odd, notes = measured_depth(pixels, scale)
            points = points_from_depth(depth, depth > 0, camera)
        if not (np.isfinite(depth).all() and np.isfinite(points).all()):
            remedy = "check the camera and the unit of depth"
            raise InputError("the frame", "its points are not finite", remedy)
        return cls(points, timestamp, camera, depth, num_odd, notes)

    def seen_by(self, camera: Camera) -> "Frame":
        """The same measurement by a camera that is known better. A depth image gives
        points anew; one of another size raises InputError."""
        if self.depth is None:
            return dataclasses.replace(self, camera=camera)
        height, width = self.depth.shape
        if (height, width) != (camera.height, camera.width):
            fault = f"{camera.width}x{camera.height} pixels, images {width}x{height}"
            raise InputError("--camera", fault, "give the camera of these images")
        seen = Frame.of_depth(self.depth, camera, self.timestamp)
        kept = ("num_not_finite", "notes", "joints", "frame_id")
        return dataclasses.replace(seen, **{name: getattr(self, name) for name in kept})


class Stream(abc.ABC):
    """Frames of one sensor from a recording, in the order in which they were recorded.

    It can be iterated over again, and from any thread. `remarks` counts what was odd;
    of each kind the first case is told in one line, which `told` keeps. `topic` is
    which of the recording's sensors it is, and `frame_id` its first frame's; `camera`,
    if given, stands in for what the recording says of all frames'; `joints` is where
    joint positions come from, None if nobody asked. `skew` is the longest time between
    a frame and the nearest sample of its joints, and how far the robot moves in it.
    """

    topic: str | None = None
    frame_id: str = ""
    camera: Camera | None = None
    joints: Joints | None = None
    skew: Mapping[str, float] | None = None
    _unknown = "no joint positions"

    def __init__(self, path: StrPath, tell: Tell | None = None):
        self.path = os.fspath(path)
        self.remarks: Counter[str] = Counter()
        self.told: dict[str, str] = {}
        self._tell = tell or to_stderr

    @abc.abstractmethod
    def __len__(self) -> int:
        """How many frames the recording says that it has; some may be unusable."""

    @abc.abstractmethod
    def _frames(self) -> Iterator[Frame]:
        """Every frame as it was recorded."""

    def __iter__(self) -> Iterator[Frame]:
        before: int | float = -np.inf
        number, sensor = 0, None
        for frame in self._frames():
            sensor = frame.frame_id if sensor is None else sensor
            if frame.frame_id != sensor:
                line = f"frame {number} is of {frame.frame_id!r}, the first of"
                self.remark("sensor", f"{line} {sensor!r}; only those are used")
                continue
            self._look_at(number, frame, before)
            frame = self._with_joints(number, self._placed(frame))
            self.frame_id = frame.frame_id
            yield frame
            before = frame.timestamp
            number += 1

    def _placed(self, frame: Frame) -> Frame:
        """The frame by the camera that was given, if one was."""
        camera = self.camera
        if camera is None:
            return frame
        if frame.camera is not camera:
            frame = frame.seen_by(camera)
        posed = np.any(camera.rotation != np.eye(3)) or np.any(camera.translation)
        if frame.depth is None or not posed:
            return frame
        return dataclasses.replace(frame, frame_id="")

    def take_joints(self, joints: Joints) -> None:
        """Has each frame tell joint positions; InputError where there are none."""
        if joints.given is None:
            self._check_joints(joints)
        self.joints = joints

    def _check_joints(self, joints: Joints) -> None:
        """Looks for joint positions in the recording."""
        named = "no joint positions" + (f" on {joints.topic}" if joints.topic else "")
        raise InputError(self.path, named, "set --joints to a .json file")

    def _with_joints(self, number: int, frame: Frame) -> Frame:
        if self.joints is None:
            return frame
        found = frame.joints if self.joints.given is None else self.joints.given
        if found is None:
            self.remark("joints", f"robot unknown in frame {number}: {self._unknown}")
            return frame
        skew = (frame.joints or {}).get("skew")
        if skew is not None and (self.skew is None or skew > self.skew["seconds"]):
            self.skew = {"seconds": skew, "metres": skew * self.joints.speed}
        base = {} if self.joints.base is None else {"base": self.joints.base}
        return dataclasses.replace(frame, joints={**found, **base})

    def remark(self, kind: str, line: str) -> None:
        """Counts something odd, and tells the first of its kind."""
        self.remarks[kind] += 1
        if self.remarks[kind] == 1:
            self.told[kind] = line
            told = f"{self.path}: {line}"
            self._tell("".join(c if c.isprintable() else " " for c in told))

    def _look_at(self, number: int, frame: Frame, before: int | float) -> None:
        if len(frame.points) == 0 and frame.num_not_finite:
            line = f"frame {number}: no return in {frame.num_not_finite:,} points"
            self.remark("not_finite", line)
        elif len(frame.points) == 0:
            self.remark("empty", f"frame {number} is empty")
        for kind, line in frame.notes.items():
            self.remark(kind, f"frame {number}: {line}")
        behind = before - frame.timestamp
        if behind > LATE:
            line = f"frame {number} is {behind / 1e9:.3f} s older than the one before"
            self.remark("backward", f"{line}; used anyway")
        if behind == 0:
            self.remark("duplicate", f"frame {number} has the time of the one before")


def chosen_topic(
    path: StrPath,
    topic: str | None,
    fitting: Collection[str],
    content: str,
    flag: str = "--topic",
) -> str:
    """The topic asked for, or the only one that fits; InputError lists those."""
    if topic in fitting:
        return str(topic)
    if topic is None and len(fitting) == 1:
        return next(iter(fitting))
    fault = f"{len(fitting)} topics with {content}"
    fault = fault if topic is None else f"no {content} on {topic}"
    raise InputError(path, fault, f"set {flag} to one of {', '.join(fitting)}")
