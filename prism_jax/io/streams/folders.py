"""Folders of clouds, of depth images, and of the recordings' layout."""

import dataclasses
import functools
import pathlib
import re
from collections.abc import Iterator

import numpy as np

from prism_jax.io.arrays import Fields
from prism_jax.io.clouds import READERS, read_cloud
from prism_jax.io.depth import (
    camera_from_dict,
    camera_to_dict,
    read_camera,
    read_counts,
)
from prism_jax.io.errors import InputError
from prism_jax.io.files import parsing, read_bytes, read_json
from prism_jax.io.streams.frame import Frame, Joints, Stream, Tell, chosen_topic

_DEPTH, _PARTIAL, _CAMERA = ".depth.png", ".partial.ply", ".camera.json"
_LEAVE = "record it again, or give --joints=FILE for all frames"
TOPICS = {"depth": _DEPTH, "partial": _PARTIAL}
"""What a frame of the recordings' layout holds of its sensor, and in which file."""


class CloudFolder(Stream):
    """The clouds of a folder, or its depth images, by the numbers in their names. A
    depth image's camera is the JSON of the same name or `camera.json`. A file that
    cannot be read is left out and remarked. Frames count as 10 a second."""

    camera_file: pathlib.Path | None = None  # in place of those, with its depth_scale
    scale: float | None = None  # metres a count, where the layout tells

    def __init__(self, path: pathlib.Path, topic: str | None, tell: Tell | None):
        super().__init__(path, tell)
        self._paths = self._found(path, topic)

    def _found(self, path: pathlib.Path, topic: str | None) -> list[pathlib.Path]:
        """The frames' files, in order."""
        if topic is not None:
            fault = f"no topics in this recording, so no {topic}"
            raise InputError(path, fault, "omit --topic")
        files = [p for p in path.iterdir() if not p.name.startswith(".")]
        clouds = [p for p in files if p.suffix.lower() in READERS]
        images = [p for p in files if p.suffix.lower() == ".png"]
        if not clouds and not images:
            remedy = f"supported: {' '.join(READERS)} .png, and ROS 2 bags"
            raise InputError(path, "no frames in this folder", remedy)
        if clouds and images:
            fault = f"folder mixes {len(clouds)} clouds and {len(images)} images"
            raise InputError(path, fault, "put them into separate folders")
        return sorted(clouds or images, key=natural)

    def __len__(self) -> int:
        return len(self._paths)

    def _frames(self) -> Iterator[Frame]:
        for number, path in enumerate(self._paths):
            try:
                yield self._read(path, number * 100_000_000)  # 10 a second
            except InputError as error:
                self.remark("damaged", f"skipped {path.name}: {error}")

    def _read(self, path: pathlib.Path, time: int) -> Frame:
        """One of the frames."""
        if path.suffix.lower() != ".png":
            return self._frame(path, None, time)
        own, common = path.with_suffix(".json"), path.with_name("camera.json")
        about = self.camera_file or (own if own.exists() else common)
        return self._frame(path, about, time)

    def _frame(
        self, path: pathlib.Path, about: pathlib.Path | None, time: int
    ) -> Frame:
        """That of a cloud or a depth image; `about` is its camera's file, if any."""
        tell = functools.partial(self.remark, "camera_file")
        if about is not None and path.suffix.lower() == ".png":
            tell = (lambda _: None) if about == self.camera_file else tell
            given = read_counts(path, about, tell=tell, scale=self.scale)
            counts, scale, camera = given
            return Frame.of_depth(counts, camera, time, scale)
        camera = None if about is None else read_camera(about, tell)
        fields: Fields = {}
        points, num_read, notes = read_cloud(path, fields=fields)
        num_lost = num_read - len(points)
        return Frame(points, time, camera, None, num_lost, notes, fields=fields)


class RecordedFrames(CloudFolder):
    """Frames in the layout of `prism_jax.data.recordings`, in the world frame, sequence
    after sequence: the topic "depth" is the depth images, "partial" the partial clouds.
    Frames count as 10 a second."""

    def _found(self, path: pathlib.Path, topic: str | None) -> list[pathlib.Path]:
        self.topic = chosen_topic(path, topic, TOPICS, "clouds or depth images")
        above = "" if any(path.glob(f"*{_DEPTH}")) else "*/"
        found = path.glob(f"{above}*{TOPICS[self.topic]}")
        return sorted(found, key=lambda p: natural(p.relative_to(path)))

    def _read(self, path: pathlib.Path, time: int) -> Frame:
        name = path.name.removesuffix(TOPICS[str(self.topic)])
        joints = path.with_name(name + ".joints.json")
        frame = self._frame(path, path.with_name(name + _CAMERA), time)
        if self.joints is not None and joints.exists():
            frame = dataclasses.replace(frame, joints=read_json(joints, _LEAVE))
        return frame

    def _check_joints(self, joints: Joints) -> None:
        if joints.topic is not None:
            fault = f"no joint topic {joints.topic}; joints are in the frames' files"
            raise InputError(self.path, fault, "omit --joints")


class DatasetFrames(CloudFolder):
    """Depth images as two data sets have them, in counts that are known: TUM RGB-D,
    which lists them with their times, and 7-Scenes, which has a pose with each, so that
    points are in its world. The camera is `camera_file`, or `camera.json` beside."""

    def _found(self, path: pathlib.Path, topic: str | None) -> list[pathlib.Path]:
        if topic is not None:
            return super()._found(path, topic)  # there are none
        lines, self._times = _listing(path), {}
        for line in lines:
            given = line.partition("#")[0].strip()
            time = re.search(r"\b(\d{1,12})\.?(\d*)\s+(\S*depth\S*)", given[:999])
            if time:
                self._times[path / time[3]] = int(time[1] + time[2][:9].ljust(9, "0"))
            elif given:
                self.remark("damaged", f"skipped in a list of images: {given:.60}")
        self.scale = 1 / 5000 if lines else 0.001
        named = "TUM RGB-D, 5000" if lines else "7-Scenes, in its world, 1000"
        line = f"read as {named} counts a metre unless the camera differs"
        self.remark("layout", line)
        return list(self._times) or sorted(path.glob(f"*{_DEPTH}"), key=natural)

    def _read(self, path: pathlib.Path, time: int) -> Frame:
        about = self.camera_file or pathlib.Path(self.path) / "camera.json"
        frame = self._frame(path, about, self._times.get(path, time))
        pose = path.with_name(path.name.removesuffix(_DEPTH) + ".pose.txt")
        if frame.camera is None or not pose.exists():
            return frame
        with parsing(pose, "a pose", "give a 4x4 matrix, camera to world"):
            matrix = np.array(read_bytes(pose).split(), np.float64).reshape(4, 4)
            turn, away = matrix[:3, :3].T, matrix[:3, 3]
            placed = {"rotation": turn, "translation": -turn @ away}
            camera = camera_from_dict(camera_to_dict(frame.camera) | placed)
        return frame.seen_by(camera)

    def _placed(self, frame: Frame) -> Frame:
        return frame


def folder_kind(path: pathlib.Path) -> type[CloudFolder]:
    """What reads a folder, or one sequence of recordings."""
    own = any(path.glob(f"*{_CAMERA}")) or any(path.glob(f"*/*{_CAMERA}"))
    if not own and (_listing(path) or any(path.glob(f"frame-*{_DEPTH}"))):
        return DatasetFrames
    is_recorded = own or any(path.glob(f"*{_DEPTH}"))
    return RecordedFrames if is_recorded else CloudFolder


def _listing(path: pathlib.Path) -> list[str]:
    """The lines in which TUM RGB-D lists depth images and their times."""
    found = [*path.glob("depth.txt"), *path.glob("assoc*.txt")]
    if not found or not (path / "depth").is_dir():
        return []
    return read_bytes(found[0]).decode(errors="replace").splitlines()


def natural(path: pathlib.Path) -> list[tuple[int, str]]:
    """Sorts 9.ply before 10.ply."""
    parts = re.findall(r"\d+|\D+", str(path))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
