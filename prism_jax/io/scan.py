"""One scan as a user hands it in: a cloud or a depth image, and its camera."""

import dataclasses
import pathlib

import numpy as np
from jaxtyping import Float

from prism_jax.geometry.camera import Camera
from prism_jax.io.arrays import Fields
from prism_jax.io.clouds import check_cloud, check_in_view, inside, read_cloud
from prism_jax.io.depth import (
    measured_depth,
    points_from_depth,
    read_camera,
    read_counts,
)
from prism_jax.io.errors import InputError, StrPath, Tell, to_stderr
from prism_jax.io.files import MAX_POINTS
from prism_jax.io.pcd import read_viewpoint
from prism_jax.io.ply import num_faces

CAMERA_FRAME_DEGREES = 10.0


@dataclasses.dataclass(frozen=True)
class Bounds:
    """An axis-aligned box in the scan's units and frame."""

    lower: Float[np.ndarray, "3"]
    upper: Float[np.ndarray, "3"]


@dataclasses.dataclass(frozen=True)
class Scan:
    """Finite points inside the bounds, as stored, and what was left out of them."""

    points: Float[np.ndarray, "N 3"]
    camera: Camera | None
    num_not_finite: int  # or lost returns: points at 0,0,0, pixels of the largest value
    num_outside: int
    # Whether they are a depth image's, in its camera's own axes (x right, y down, z
    # forward) or in axes turned by less than `CAMERA_FRAME_DEGREES`.
    in_camera_frame: bool = False
    # The finite points outside the bounds; None without bounds.
    around: Float[np.ndarray, "R 3"] | None = None
    # Where the file of a cloud says that its sensor stood, if there is no camera.
    eye: Float[np.ndarray, "3"] | None = None
    # Of each point what else the file of a cloud has: colours, normals, intensity.
    fields: Fields = dataclasses.field(default_factory=dict)
    # Of all lengths: a depth image's are metres by its scale, a cloud's are anything.
    unit: str = "input units"


def read_scan(
    path: StrPath,
    camera_path: StrPath | None = None,
    bounds: Bounds | None = None,
    max_points: int = MAX_POINTS,
    tell: Tell = to_stderr,
) -> Scan:
    """A scan ready to be completed; an InputError says why there is none.

    A `.png` is a depth image; its camera is `camera_path`, or the `.json` of the same
    name beside it, and the points are in the frame that the camera's pose refers to.
    For any other file see `read_points`. Points outside `bounds` are kept apart. `tell`
    gets a line for each kind of oddity.
    """
    in_camera_frame, eye, subject, fields, unit = False, None, path, {}, Scan.unit
    if pathlib.Path(path).suffix.lower() == ".png":
        beside = pathlib.Path(path).with_suffix(".json")
        if not camera_path and not beside.exists():
            remedy = f"set --camera, or add {beside.name} next to the image"
            raise InputError(path, "depth image without a camera", remedy)
        camera_path = camera_path or beside
        counts, scale, camera = read_counts(path, camera_path, max_points, tell)
        depth, num_odd, notes = measured_depth(counts, scale)
        if not depth.any():
            raise InputError(path, "no valid depth pixels", "check the sensor")
        points = points_from_depth(depth, depth > 0, camera)
        in_camera_frame, unit = in_own_axes(camera), "m"
        num_read = len(points) + num_odd
        if scale >= 1 and depth.max() > 1000:
            cause = f"depth_scale {scale:g}, where 0.001 means millimetres"
            subject = f"{camera_path}: {cause}"  # of whatever is wrong
            notes["scale"] = f"depths are up to {depth.max():,.0f} by {cause}"
    else:
        camera = read_camera(camera_path, tell) if camera_path else None
        points, num_read, notes = read_cloud(path, max_points, fields=fields)
        suffix = pathlib.Path(path).suffix.lower()
        if camera is None and suffix == ".pcd":
            eye = read_viewpoint(path)
        if suffix == ".ply" and (faces := num_faces(path)):
            told = f"a mesh of {faces:,} faces, not a scan: its vertices are taken for "
            notes["mesh"] = told + "measured points; sample what a sensor would see"
    for line in notes.values():
        tell(f"{path}: {line}")
    num_finite = len(points)
    if bounds is not None:
        held = inside(points, bounds.lower, bounds.upper)
        fields = {name: column[held] for name, column in fields.items()}
    points, around = parted(points, bounds, path)
    check_cloud(points, subject)
    if camera is not None:
        check_in_view(points, camera, path)
    left_out = num_read - num_finite, num_finite - len(points)
    return Scan(points, camera, *left_out, in_camera_frame, around, eye, fields, unit)


def standing_at(eye: Float[np.ndarray, "3"]) -> Camera:
    """A camera that says no more than where it stands; its up is z."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return Camera(rotation, -rotation @ eye, np.eye(3), 1, 1)


def parted(
    points: Float[np.ndarray, "N 3"], bounds: Bounds | None, subject: StrPath
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "R 3"] | None]:
    """The points inside the bounds, and those outside; None of these without bounds.
    InputError about `subject` if there are none inside."""
    if bounds is None:
        return points, None
    held = inside(points, bounds.lower, bounds.upper)
    kept = points[held]
    if len(kept) == 0:
        lower, upper = points.min(axis=0), points.max(axis=0)
        spans = ",".join(f"{value:.6g}" for value in (*lower, *upper))
        remedy = f"the points span {spans} (x0,y0,z0,x1,y1,z1)"
        raise InputError(subject, "no points inside --workspace", remedy)
    return kept, points[~held]


def parse_bounds(text: str) -> Bounds:
    """Bounds from `x0,y0,z0,x1,y1,z1`; InputError if that is not a box."""
    remedy = "give x0,y0,z0,x1,y1,z1 with x0 < x1, y0 < y1 and z0 < z1"
    values = parse_numbers("--workspace", text, 6, remedy)
    if not (values[:3] < values[3:]).all():
        raise InputError("--workspace", f"{text!r} has no volume", remedy)
    return Bounds(values[:3], values[3:])


def parse_numbers(
    flag: str, text: str, count: int, remedy: str
) -> Float[np.ndarray, " count"]:
    """So many finite numbers with commas between them; InputError of anything else."""
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(flag, f"cannot read {text!r}", remedy)
    return values


def in_own_axes(camera: Camera) -> bool:
    """Whether points are in the camera's own axes, turned by less than
    `CAMERA_FRAME_DEGREES`."""
    cosine = (np.trace(np.asarray(camera.rotation)) - 1.0) / 2.0
    return bool(cosine > np.cos(np.radians(CAMERA_FRAME_DEGREES)))
