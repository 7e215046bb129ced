"""Cameras as JSON or YAML, and 16-bit depth images."""

import io
import json
import re
from collections.abc import Mapping
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Bool, Float, Num, UInt
from PIL import Image, UnidentifiedImageError

from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import StrPath, Tell, to_stderr
from prism_jax.io.files import MAX_POINTS, check_count, parsing, read_bytes, read_json

MAX_SIDE = 16_384  # pixels: an image with a longer side is refused

_FAR = 1e9  # numbers beyond it, and parts of a pixel below one of it, are none

_BLOCK = 4096
"""Points turned at once: a larger product would wake all cores for next to nothing."""

_OTHER_NAMES = {"ppx": "cx", "ppy": "cy"}  # RealSense's
_OTHER_NAMES |= {"image_width": "width", "image_height": "height"}  # OpenCV's
_MATRICES = "intrinsic_matrix", "camera_matrix", "cameraMatrix", "cam_K", "K", "k"
_DISTORTION = r"(dist\w*_?)?coef\w*|distort\w*|d|[kp][1-6]"
_POSE = r".*(extrinsic|pose|transform|world|w2c|c2w).*"

_LAYOUT = (
    'write {"width":, "height":, "fx":, "fy":, "cx":, "cy":} in pixels, and for a '
    'cloud in another frame "rotation" (3x3) and "translation" (3)'
)


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """A camera as JSON values; `camera_from_dict` gives the same camera back."""
    (fx, _, cx), (_, fy, cy), _ = np.asarray(camera.intrinsics).tolist()
    return {
        "width": camera.width,
        "height": camera.height,
        **{"fx": fx, "fy": fy, "cx": cx, "cy": cy},
        "rotation": np.asarray(camera.rotation).tolist(),
        "translation": np.asarray(camera.translation).tolist(),
    }


def camera_from_dict(entries: dict[str, Any]) -> Camera:
    """A camera of NumPy float64 arrays from its JSON values.

    `width height fx fy cx cy` are in pixels, with pixel centres at integers; `rotation`
    and `translation` take the points' frame to the camera's, by default the identity.
    The names of RealSense, Open3D, OpenCV, BOP and ROS are taken for ours. Anything
    missing or impossible raises a ValueError that says what.
    """
    entries = _by_our_names(entries)
    width, height = (_integer(entries, key) for key in ("width", "height"))
    fx, fy, cx, cy = (_number(entries, key) for key in ("fx", "fy", "cx", "cy"))
    if min(fx, fy) * _FAR < 1:
        raise ValueError("fx and fy must be positive")
    rotation = array_of(entries, "rotation", np.eye(3))
    check_rotation(rotation, 1e-3)
    return Camera(
        rotation=rotation,
        translation=array_of(entries, "translation", np.zeros(3)),
        intrinsics=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        height=height,
        width=width,
    )


def _by_our_names(entries: dict[str, Any]) -> dict[str, Any]:
    """Entries of a camera with those of other tools. A matrix may be nested or flat, by
    rows or by columns: its last row tells."""
    inner = entries.get("intrinsic", entries.get("intrinsics"))
    entries = (inner if isinstance(inner, dict) else {}) | entries
    theirs = {our: entries[key] for key, our in _OTHER_NAMES.items() if key in entries}
    entries = theirs | entries
    for name in (name for name in _MATRICES if name in entries):
        given = _bare(entries[name])
        is_nested = isinstance(given, list) and isinstance((given or [0])[0], list)
        shape = (3, 3) if is_nested else 9
        matrix = array_of({name: given}, name, np.zeros(shape)).reshape(3, 3)
        matrix = matrix.T if matrix[2, :2].any() else matrix
        fx, _, cx, _, fy, cy, *_ = matrix.ravel().tolist()
        entries = {"fx": fx, "fy": fy, "cx": cx, "cy": cy} | entries
    return entries


def _bare(value: Any) -> Any:
    """A matrix as OpenCV and ROS have it, without its size."""
    return value.get("data") if isinstance(value, dict) else value


def read_camera(path: StrPath, tell: Tell = to_stderr) -> Camera:
    """The camera of a JSON file, or of a YAML file of ROS or OpenCV, as
    `camera_from_dict`; InputError if it has none. What the file says beside that and is
    not used is told."""
    return _read_camera_entries(path, tell)[0]


def read_depth(
    path: StrPath,
    camera_path: StrPath,
    max_points: int = MAX_POINTS,
    tell: Tell = lambda _: None,
) -> tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"], Camera]:
    """Depth in metres, 0 where nothing was measured, the mask of measured pixels, and
    the camera; see `read_counts` and `measured_depth`."""
    counts, scale, camera = read_counts(path, camera_path, max_points, tell)
    depth, _, notes = measured_depth(counts, scale)
    for line in notes.values():
        tell(f"{path}: {line}")
    return depth, depth > 0, camera


def read_counts(
    path: StrPath,
    camera_path: StrPath,
    max_points: int = MAX_POINTS,
    tell: Tell = to_stderr,
    scale: float | None = None,
) -> tuple[UInt[np.ndarray, "H W"], float, Camera]:
    """The pixels of a depth image, metres a count, and the camera. The image is a
    16-bit grey PNG; its camera's JSON also has `depth_scale`, metres a count, or it is
    `scale`. Whatever does not fit raises an InputError before the image is unpacked."""
    camera, entries = _read_camera_entries(camera_path, tell)
    remedy = 'add "depth_scale": metres per count, as 0.001'
    with parsing(camera_path, "the camera of a depth image", remedy):
        known = {} if scale is None else {"depth_scale": scale}
        scale = _number(known | entries, "depth_scale")
        if scale <= 0:
            raise ValueError("depth_scale must be positive")
    return read_grey(path, camera, 16, max_points), scale, camera


def measured_depth(
    pixels: Num[np.ndarray, "H W"], scale: float
) -> tuple[Float[np.ndarray, "H W"], int, dict[str, str]]:
    """Depth in units of `scale`, 0 where there was no return. That is a pixel of 0, and
    an odd one: negative, not finite, or the largest value of an integer type, which
    many sensors write for a lost return. Also how many are odd, and what to tell of
    them; NaN is too common for that."""
    odd, what = ~np.isfinite(pixels) | (pixels < 0), "infinite or negative depth"
    if pixels.dtype.kind == "u":
        odd, what = pixels == np.iinfo(pixels.dtype).max, "the largest value"
    notes, count = {}, int((odd & ~np.isnan(pixels)).sum())
    if count:
        notes["no_return"] = f"{count:,} pixels of {what} count as no return"
    depth = np.where(odd, pixels.dtype.type(0), pixels) * scale
    return depth, int(odd.sum()), notes


def points_from_depth(
    depth: Float[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"], camera: Camera
) -> Float[np.ndarray, "N 3"]:
    """The measured pixels as points in the frame the camera's pose refers to, float64.
    Row by row, in the units of `depth`, which is measured along the camera's +z."""
    rows, columns = np.nonzero(mask)
    (fx, skew, cx), (_, fy, cy), _ = np.asarray(camera.intrinsics, np.float64)
    y = (rows - cy) * (1.0 / fy)
    x = (columns - cx - skew * y) * (1.0 / fx)
    z = depth[rows, columns].astype(np.float64)
    moved = np.stack([x * z, y * z, z], axis=1) - np.asarray(camera.translation)
    points = np.empty_like(moved)
    for start in range(0, len(moved), _BLOCK):
        block = slice(start, start + _BLOCK)
        points[block] = moved[block] @ np.asarray(camera.rotation)
    return points


def _read_camera_entries(path: StrPath, tell: Tell) -> tuple[Camera, dict[str, Any]]:
    entries = read_json(path, _LAYOUT)
    with parsing(path, "a valid camera", _LAYOUT):
        camera = camera_from_dict(entries)
    for key, value in entries.items():
        of_lens = re.fullmatch(_DISTORTION, key.lower()) and not isinstance(value, str)
        if of_lens and re.search("[1-9]", json.dumps(_bare(value), default=str)):
            tell(f"{path}: {key} is lens distortion, which is not undone")
        if re.fullmatch(_POSE, key.lower()):
            tell(f"{path}: {key} is not used; a pose is rotation and translation")
    return camera, entries


def read_grey(
    path: StrPath, camera: Camera, bits: int, max_points: int = MAX_POINTS
) -> UInt[np.ndarray, "H W"]:
    """The pixels of a PNG of the camera's size, 8 or 16 bits each; InputError if it has
    others, or more than `max_points`, before it is unpacked."""
    data = read_bytes(path)
    remedy = f"store {bits}-bit grey of the camera's size, 0 for no return"
    kind = f"a valid {'depth' if bits == 16 else 'label'} image"
    # Pillow raises errors of many kinds.
    with parsing(path, kind, remedy, Exception):
        try:
            image = Image.open(io.BytesIO(data), formats=["PNG"])
        except UnidentifiedImageError:
            raise ValueError("not a PNG") from None
        if not image.mode.startswith({8: "L", 16: "I;16"}[bits]):
            raise ValueError(f"pixels are {image.mode}, not {bits}-bit grey")
        check_count(image.width * image.height, max_points, "pixels")
        if image.size != (camera.width, camera.height):
            sizes = f"{image.width}x{image.height}, camera is "
            raise ValueError(f"image is {sizes}{camera.width}x{camera.height}")
        return np.asarray(image)


def _number(entries: dict[str, Any], key: str) -> float:
    value = entries.get(key)
    if not is_finite(value):
        raise ValueError(f"{key} is missing or not a finite number")
    return float(value)


def _integer(entries: dict[str, Any], key: str) -> int:
    value = _number(entries, key)
    if value != int(value) or not 1 <= value <= MAX_SIDE:
        raise ValueError(f"{key} must be an integer from 1 to {MAX_SIDE}")
    return int(value)


def array_of(
    entries: Mapping[str, Any], key: str, default: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """An entry as an array of the default's shape; ValueError if it is none. The
    default without such an entry."""
    if key not in entries:
        return default
    # As objects: of strings NumPy would make all as long as the longest.
    array = np.array(entries[key], object)
    if array.shape != default.shape or not all(map(is_finite, array.flat)):
        shape = "x".join(map(str, default.shape))
        raise ValueError(f"{key} must be {shape} finite numbers")
    return array.astype(np.float64)


def check_rotation(rotation: Float[np.ndarray, "3 3"], tolerance: float) -> None:
    """ValueError if this is no rotation."""
    if np.abs(rotation).max() > 2 or not np.allclose(
        rotation @ rotation.T, np.eye(3), atol=tolerance
    ):
        raise ValueError("rotation is not orthogonal")
    if np.linalg.det(rotation) < 0:
        raise ValueError("rotation is a reflection")


def is_finite(value: Any) -> TypeGuard[float]:
    """Whether this is a number, and not too large for a length or an angle."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and abs(value) <= _FAR
