"""Recorded robot cells: a folder of depth images, partial clouds and ground truth.

    <root>/<sequence>/<frame>.depth.png     16-bit depth, `DEPTH_SCALE` metres a count
                      <frame>.camera.json   as `io.depth` reads it, with depth_scale
                      <frame>.partial.ply   what the depth camera saw of the cell
                      <frame>.complete.ply  optional: the ground truth
                      <frame>.labels.png    optional: 8 bit, one of `LABELS` a pixel
                      <frame>.joints.json   optional: the robot's pose, any JSON object
    <root>/manifest.json                    optional: the sha256 of every file

A frame's name is six digits. Clouds and camera share the world frame: metres, z up,
the floor at z = 0, the robot's base on the z axis. The camera is written last, so a
frame that has one is complete.
"""

import dataclasses
import json
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16

from prism_jax.assets import asset
from prism_jax.data.manifest import MANIFEST, check_files, read_manifest
from prism_jax.data.source import Example
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import Visibility, framing_camera
from prism_jax.io.clouds import check_cloud
from prism_jax.io.depth import points_from_depth, read_depth, read_grey
from prism_jax.io.errors import InputError, StrPath
from prism_jax.io.files import read_bytes, read_json
from prism_jax.io.ply import read_ply
from prism_jax.preprocessing.visibility_map import seen_among

DEPTH_SCALE = 0.00025  # metres a count of the depth image: the L515's own unit

LABELS = {"nothing": 0, "robot": 1, "clutter": 2, "fixture": 3, "person": 4}
"""What a pixel sees: no return; the robot; what is neither asked for nor in the clouds
(floor, table, fence, boxes); the fixtures, which are part of the clouds; people, who
are not."""

MAX_METRES = 50.0  # a coordinate beyond this is not in metres, or not of a cell
NEAR = 0.03
"""Metres along a pixel's ray: a partial's point this near its pixel's depth fits it."""
RAYS_A_PIXEL = 5  # of a depth image, about so many for each pixel of a map

NEEDED = ("camera.json", "depth.png", "partial.ply")
OPTIONAL = ("complete.ply", "labels.png", "joints.json")
"""Files of a frame, by what follows its number."""
_COPY = "copy the whole frame again, or delete what is there of it"
_LAYOUT = "lay it out as <sequence>/000000.depth.png, .camera.json, .partial.ply"


@dataclasses.dataclass(frozen=True)
class RecordedFrame:
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

    File names are checked when this is made, contents when an example is read; faults
    and a file that differs from the manifest raise InputError, as does a manifest that
    does not say what is `expected`. A sequence counts as one object. Its category is
    the robot if its name tells it, as 003-ur5 does. What the sensor knows is told by
    the whole depth image, and by no labels.
    """

    def __init__(
        self, root: StrPath, remedy: str = "let the recording finish", **expected: Any
    ):
        self.root = pathlib.Path(root)
        if expected or (self.root / MANIFEST).exists():
            manifest = read_manifest(self.root, remedy, **expected)
            check_files(self.root, manifest["files"], _COPY)
        self.frames = _find_frames(self.root)
        sequences = [sequence for sequence, _ in self.frames]
        self.objects = np.unique(sequences, return_inverse=True)[1]
        self.categories = tuple(dict.fromkeys(map(_category, sequences)))

    @classmethod
    def bundled(cls) -> "RecordedCells":
        """One frame that ships with the package: a Panda in its cell, simulated."""
        return cls(asset("roboarm"))

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Example:
        sequence, name = self.frames[index]
        frame = self.root / sequence / name
        image = frame.with_suffix(".depth.png"), frame.with_suffix(".camera.json")
        metres, mask, camera = read_depth(*image)
        partial = _read_cloud(frame.with_suffix(".partial.ply"))
        complete = frame.with_suffix(".complete.ply")
        return Example(
            complete=_read_cloud(complete) if complete.exists() else None,
            partial=partial,
            eye=np.asarray(camera.position, np.float32),
            category=_category(sequence),
            name=f"{sequence}/{name}",
            any_heading=True,
            visibility=map_of_image(partial, metres, mask, camera),
        )

    def read(self, index: int) -> RecordedFrame:
        """All of a frame. Files that do not fit each other raise InputError: images of
        another size than the camera's, another unit of depth, a partial cloud that lies
        elsewhere than the depth image, labels that do not exist."""
        frame = self.root.joinpath(*self.frames[index])
        view, image, cloud, complete, labels, joints = (
            frame.with_suffix(f".{each}") for each in NEEDED + OPTIONAL
        )
        metres, mask, camera = read_depth(image, view)
        scale = json.loads(read_bytes(view))["depth_scale"]
        if not np.isclose(scale, DEPTH_SCALE, rtol=1e-6):
            fault = f"depth_scale is {scale:g}, not {DEPTH_SCALE}"
            raise InputError(view, fault, "convert the image to 0.25 mm per count")
        if not mask.any():
            raise InputError(image, "no valid depth pixels", "check the sensor")
        partial = _read_cloud(cloud)
        _check_on_image(partial, metres, mask, camera, cloud)
        return RecordedFrame(
            depth=np.rint(metres / scale).astype(np.uint16),
            camera=camera,
            partial=partial,
            complete=_read_cloud(complete) if complete.exists() else None,
            labels=_read_labels(labels, camera) if labels.exists() else None,
            joints=read_json(joints, _COPY) if joints.exists() else None,
        )


def map_of_image(
    partial: Float[np.ndarray, "N 3"],
    depth: Float[np.ndarray, "H W"],
    mask: Bool[np.ndarray, "H W"],
    camera: Camera,
) -> Visibility:
    """What a depth camera knows of its view of a partial cloud, by its whole image. Of
    the image's pixels about `RAYS_A_PIXEL` are taken for each of the map's. All in one
    frame and unit; see `prism_jax.preprocessing.visibility_map.seen_among`."""
    eye = np.asarray(camera.position, np.float64)
    close = framing_camera(partial.astype(np.float64), eye).intrinsics[0, 0]
    step = max(1, int(camera.intrinsics[0, 0] / close / np.sqrt(RAYS_A_PIXEL)))
    few = np.zeros_like(mask)
    few[::step, ::step] = mask[::step, ::step]
    around = points_from_depth(depth, few, camera)
    return seen_among(partial, around, eye)


def _category(sequence: str) -> str:
    """What the sequence shows: the robot, if it is named as the simulator does it."""
    named = re.fullmatch(r"\d+-(.+)", sequence)
    return "robot cell" if named is None else named[1]


def _find_frames(root: pathlib.Path) -> tuple[tuple[str, str], ...]:
    """Every (sequence, frame), without hidden files and folders."""
    if not root.is_dir():
        raise InputError(root, "not a folder", "give the folder of the recordings")
    frames: dict[tuple[str, str], set[str]] = {}
    for path in sorted(root.glob("[!.]*/[!.]*")):
        name, _, suffix = path.name.partition(".")
        if not re.fullmatch(r"[0-9]{6}", name):
            raise InputError(path, "name is not six digits", _LAYOUT)
        if suffix not in NEEDED + OPTIONAL:
            known = " ".join(NEEDED + OPTIONAL)
            raise InputError(path, f"not one of {known}", "move it elsewhere")
        frames.setdefault((path.parent.name, name), set()).add(suffix)
    if not frames:
        raise InputError(root, "no recorded frames", _LAYOUT)
    for frame, found in frames.items():
        for suffix in NEEDED:
            if suffix not in found:
                path = root.joinpath(*frame).with_suffix(f".{suffix}")
                raise InputError(path, "file missing from its frame", _COPY)
    return tuple(frames)


def _read_cloud(path: pathlib.Path) -> Float32[np.ndarray, "N 3"]:
    points = read_ply(path)
    check_cloud(points, path)
    if np.abs(points).max() > MAX_METRES:
        fault = f"extends to {np.abs(points).max():.6g} m from the origin"
        raise InputError(path, fault, "store metres, in the cell's frame")
    return points.astype(np.float32)


def _check_on_image(partial, metres, mask, camera: Camera, path: pathlib.Path) -> None:
    """At least half of the points lie on the depth of the pixel that sees them."""
    pixel, z = map(np.asarray, camera.pixel_of(partial.astype(np.float64)))
    measured = np.append(np.where(mask, metres, np.inf), np.inf)  # also of no pixel
    fitting = np.count_nonzero(np.abs(measured[pixel] - z) < NEAR)
    if 2 * fitting < len(partial):
        fault = f"{fitting} of {len(partial)} points match the depth image"
        raise InputError(path, fault, "store metres in the frame of the camera's pose")


def _read_labels(path: pathlib.Path, camera: Camera) -> UInt8[np.ndarray, "H W"]:
    labels = read_grey(path, camera, 8)
    if labels.max() > max(LABELS.values()):
        raise InputError(path, f"invalid label {labels.max()}", f"use {LABELS}")
    return labels
