"""Recorded robot cells: a folder of depth images, partial clouds and ground truth.

    <root>/<sequence>/<frame>.depth.png     16-bit depth, `DEPTH_SCALE` metres a count
                      <frame>.camera.json   as `io.depth` reads it, with depth_scale
                      <frame>.partial.ply   what the depth camera saw of the cell
                      <frame>.complete.ply  optional: the ground truth
                      <frame>.labels.png    optional: 8 bit, one of `LABELS` a pixel
                      <frame>.joints.json   optional: the robot's pose, any JSON object
    <root>/manifest.json                    optional: the sha256 of every file

A frame's name is six digits. Clouds and camera share the world frame: metres, z up,
the floor at z = 0, the robot's base on the z axis. A frame is there once its camera is,
which is written last.
"""

import dataclasses
import io
import json
import os
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from PIL import Image, UnidentifiedImageError

from prism_jax.assets import asset
from prism_jax.data.builds import MANIFEST, hash_files
from prism_jax.data.source import Example
from prism_jax.geometry.camera import Camera
from prism_jax.io.atomic import make_output_dir, write_bytes
from prism_jax.io.clouds import check_cloud, inside_image
from prism_jax.io.depth import camera_to_dict, read_camera, read_depth
from prism_jax.io.errors import InputError
from prism_jax.io.files import read_bytes
from prism_jax.io.ply import read_ply, write_ply

DEPTH_SCALE = 0.00025
"""Metres a count of the depth image: the L515's own unit."""

LABELS = {"nothing": 0, "robot": 1, "clutter": 2, "fixture": 3}
"""What a pixel sees: no return; the robot; what is neither asked for nor in the clouds
(floor, table, fence, boxes); the fixtures, which are part of the clouds."""

MAX_METRES = 50.0
"""A coordinate beyond this is not in metres, or not of a cell."""
NEAR = 0.03
"""Metres along a pixel's ray: a partial's point this near its pixel's depth fits it."""

_NEEDED = ("camera.json", "depth.png", "partial.ply")
_OPTIONAL = ("complete.ply", "labels.png", "joints.json")
_COPY = "copy the whole frame again, or delete what is there of it"
_LAYOUT = "lay it out as <sequence>/000000.depth.png, .camera.json, .partial.ply"


@dataclasses.dataclass(frozen=True)
class Frame:
    """One frame as it is stored: clouds in the world frame, depth in counts of
    `DEPTH_SCALE` (0 is no return), labels of `LABELS`."""

    depth: UInt16[np.ndarray, "H W"]
    camera: Camera
    partial: Float32[np.ndarray, "N 3"]
    complete: Float32[np.ndarray, "M 3"] | None = None
    labels: UInt8[np.ndarray, "H W"] | None = None
    joints: Mapping[str, Any] | None = None


class RecordedCells:
    """The frames below a folder as a `Source` of examples, in order of their names.

    Every file is looked at by name when this is made: what is not the layout, half a
    frame, and, with `verify`, a file that differs from the manifest's sha256, raise
    InputError. Contents are read with the example. A sequence is one object.
    """

    categories = ("robot cell",)

    def __init__(self, root: str | os.PathLike, verify: bool = True):
        self.root = pathlib.Path(root)
        found = _find_frames(self.root)
        if verify:
            _verify(self.root, found)
        self.frames = tuple(found)
        sequences = [sequence for sequence, _ in found]
        self.objects = np.unique(sequences, return_inverse=True)[1]

    @classmethod
    def bundled(cls) -> "RecordedCells":
        """One frame that ships with the package: a Panda in its cell, simulated."""
        return cls(asset("roboarm"))

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Example:
        sequence, name = self.frames[index]
        frame = self.root / sequence / name
        complete = _file(frame, "complete.ply")
        camera = read_camera(_file(frame, "camera.json"))
        return Example(
            complete=_read_cloud(complete) if complete.exists() else None,
            partial=_read_cloud(_file(frame, "partial.ply")),
            eye=np.asarray(camera.position, np.float32),
            category=self.categories[0],
            name=f"{sequence}/{name}",
            any_heading=True,
        )

    def read(self, index: int) -> Frame:
        """All of a frame, each file checked against the others."""
        sequence, name = self.frames[index]
        return read_frame(self.root / sequence, int(name))


def write_frame(folder: str | os.PathLike, number: int, frame: Frame) -> None:
    """Writes a frame into a sequence's folder; its camera, and so the frame, last.

    A frame of that number that is there already is replaced.
    """
    path = make_output_dir(folder) / f"{number:06d}"
    for suffix in _NEEDED + _OPTIONAL:
        _file(path, suffix).unlink(missing_ok=True)
    write_bytes(_file(path, "depth.png"), _png(frame.depth))
    write_ply(_file(path, "partial.ply"), frame.partial)
    if frame.complete is not None:
        write_ply(_file(path, "complete.ply"), frame.complete)
    if frame.labels is not None:
        write_bytes(_file(path, "labels.png"), _png(frame.labels))
    if frame.joints is not None:
        write_bytes(_file(path, "joints.json"), _json(frame.joints))
    camera = camera_to_dict(frame.camera) | {"depth_scale": DEPTH_SCALE}
    write_bytes(_file(path, "camera.json"), _json(camera))


def has_frame(folder: str | os.PathLike, number: int) -> bool:
    """Whether a frame was written to its end."""
    return _file(pathlib.Path(folder) / f"{number:06d}", "camera.json").exists()


def read_frame(folder: str | os.PathLike, number: int) -> Frame:
    """A frame of a sequence's folder.

    Files that do not fit each other raise InputError: images of another size than the
    camera's, another unit of depth, a partial cloud that lies elsewhere than the depth
    image (it is then in another frame or unit), labels that do not exist.
    """
    path = pathlib.Path(folder) / f"{number:06d}"
    image, camera_path = _file(path, "depth.png"), _file(path, "camera.json")
    metres, mask, camera = read_depth(image, camera_path)
    scale = json.loads(read_bytes(camera_path))["depth_scale"]
    if not np.isclose(scale, DEPTH_SCALE, rtol=1e-6):
        fault = f"has depth_scale {scale:g}, not {DEPTH_SCALE}"
        raise InputError(camera_path, fault, "convert the image to 0.25 mm a count")
    if not mask.any():
        raise InputError(image, "has no pixel with a return", "check the sensor")
    partial = _read_cloud(_file(path, "partial.ply"))
    _check_on_image(partial, metres, mask, camera, _file(path, "partial.ply"))
    complete, labels = _file(path, "complete.ply"), _file(path, "labels.png")
    joints = _file(path, "joints.json")
    return Frame(
        depth=np.rint(metres / scale).astype(np.uint16),
        camera=camera,
        partial=partial,
        complete=_read_cloud(complete) if complete.exists() else None,
        labels=_read_labels(labels, camera) if labels.exists() else None,
        joints=_read_object(joints) if joints.exists() else None,
    )


def check_recordings(root: str | os.PathLike, verify: bool = True) -> int:
    """Reads every frame below a folder and returns their number.

    The first fault raises InputError with the file, what is wrong with it, and what to
    do about it.
    """
    cells = RecordedCells(root, verify)
    for index in range(len(cells)):
        cells.read(index)
    return len(cells)


def _file(frame: pathlib.Path, suffix: str) -> pathlib.Path:
    return frame.with_name(f"{frame.name}.{suffix}")


def _find_frames(root: pathlib.Path) -> dict[tuple[str, str], list[pathlib.Path]]:
    """The files of every (sequence, frame), without hidden files and folders."""
    if not root.is_dir():
        raise InputError(root, "is not a folder", "name the folder of the recordings")
    frames: dict[tuple[str, str], list[pathlib.Path]] = {}
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        if folder.name.startswith("."):
            continue
        for path in sorted(folder.iterdir()):
            if path.name.startswith("."):
                continue
            name, _, suffix = path.name.partition(".")
            if not re.fullmatch(r"[0-9]{6}", name):
                raise InputError(path, "is not named by six digits", _LAYOUT)
            if suffix not in _NEEDED + _OPTIONAL:
                known = " ".join(_NEEDED + _OPTIONAL)
                raise InputError(path, f"is none of {known}", "move it elsewhere")
            frames.setdefault((folder.name, name), []).append(path)
    if not frames:
        raise InputError(root, "holds no recorded frames", _LAYOUT)
    for (sequence, name), files in frames.items():
        for suffix in _NEEDED:
            path = root / sequence / f"{name}.{suffix}"
            if path not in files:
                raise InputError(path, "is missing from its frame", _COPY)
    return frames


def _verify(root: pathlib.Path, frames: Mapping[Any, list[pathlib.Path]]) -> None:
    """Holds the files against the manifest, if there is one."""
    manifest = root / MANIFEST
    if not manifest.exists():
        return
    expected = _read_object(manifest).get("files")
    if not isinstance(expected, dict):
        fault = "lists no files: these recordings are not finished"
        raise InputError(manifest, fault, "let what makes them run to its end")
    found = hash_files(root)
    for name in sorted(expected.keys() | found.keys()):
        path = root / name
        if name not in found:
            raise InputError(path, "is missing and in the manifest", _COPY)
        if name not in expected:
            raise InputError(path, "is not in the manifest", "move it elsewhere")
        if expected[name] != found[name]:
            raise InputError(path, "differs from the manifest's sha256", _COPY)


def _read_cloud(path: pathlib.Path) -> Float32[np.ndarray, "N 3"]:
    points = read_ply(path)
    check_cloud(points, path)
    if np.abs(points).max() > MAX_METRES:
        fault = f"reaches {np.abs(points).max():.6g} m from the origin"
        raise InputError(path, fault, "store metres, in the cell's frame")
    return points.astype(np.float32)


def _check_on_image(partial, metres, mask, camera: Camera, path: pathlib.Path) -> None:
    """At least half of the points lie on the depth of the pixel that sees them."""
    in_camera = np.asarray(camera.to_camera(partial.astype(np.float64)))
    in_camera = in_camera[in_camera[:, 2] > NEAR]
    image = in_camera @ np.asarray(camera.intrinsics).T
    pixels = np.floor(image[:, :2] / image[:, 2:] + 0.5)
    seen = inside_image(pixels, camera)
    columns, rows = pixels[seen].astype(int).T
    gap = np.abs(metres[rows, columns] - in_camera[seen, 2])
    fitting = np.count_nonzero((gap < NEAR) & mask[rows, columns])
    if 2 * fitting < len(partial):
        raise InputError(
            path,
            f"has {fitting} of {len(partial)} points where the depth image has them",
            "store it in metres in the frame that the camera's pose refers to",
        )


def _read_labels(path: pathlib.Path, camera: Camera) -> UInt8[np.ndarray, "H W"]:
    data = read_bytes(path)
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            if image.mode != "L" or image.size != (camera.width, camera.height):
                fault = f"is {image.mode} of {image.width}x{image.height} pixels"
                remedy = f"store 8-bit grey of {camera.width}x{camera.height}"
                raise InputError(path, fault, remedy)
            labels = np.array(image)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "is not a PNG image", _COPY) from None
    if labels.max() > max(LABELS.values()):
        raise InputError(path, f"has the label {labels.max()}", f"use {LABELS}")
    return labels


def _read_object(path: pathlib.Path) -> dict[str, Any]:
    try:
        entries = json.loads(read_bytes(path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        entries = None
    if not isinstance(entries, dict):
        raise InputError(path, "is not a JSON object", _COPY)
    return entries


def _png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _json(entries: Mapping[str, Any]) -> bytes:
    return (json.dumps(entries, indent=1) + "\n").encode()
