"""Point clouds from files of every kind, checked and cropped."""

import pathlib

import numpy as np
from jaxtyping import Bool, Float

from prism_jax.geometry.camera import MIN_DEPTH, Camera
from prism_jax.io.arrays import Fields, read_kitti, read_npy, read_npz
from prism_jax.io.errors import InputError, StrPath
from prism_jax.io.files import MAX_POINTS
from prism_jax.io.las import read_las
from prism_jax.io.pcd import read_pcd
from prism_jax.io.ply import read_ply
from prism_jax.io.text import read_text

MIN_POINTS = 64  # a cloud needs at least so many distinct points

MAX_EXTENT = 10_000.0
"""A longer cloud is in units too small for what it shows, or has stray points."""

READERS = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".npy": read_npy,
    ".npz": read_npz,
    **dict.fromkeys((".xyz", ".txt", ".csv", ".pts", ".asc", ".xyzrgb"), read_text),
    ".bin": read_kitti,
    **dict.fromkeys((".las", ".laz"), read_las),
}
MESHES = (".obj", ".stl", ".off", ".glb", ".gltf", ".dae", ".3ds")

NUM_STEPS = 100  # fewer that coordinates are rounded to across an object are told


def read_points(
    path: StrPath, max_points: int = MAX_POINTS
) -> Float[np.ndarray, "N 3"]:
    """The finite points of a cloud file, in its units and frame: of `READERS` by its
    suffix, each value as stored, without lost returns (`measured`). A malformed file,
    more than `max_points` points and a cloud without a finite point raise an
    InputError, before memory is taken for what a header claims."""
    return read_cloud(path, max_points)[0]


def read_cloud(
    path: StrPath,
    max_points: int = MAX_POINTS,
    are_returns: bool = True,
    fields: Fields | None = None,
) -> tuple[Float[np.ndarray, "N 3"], int, dict[str, str]]:
    """As `read_points`, with the number of points in the file, and what is to be told,
    a line for each kind. Points that are nobody's returns may lie at 0,0,0. `fields`
    gets further numbers of the same points, by their names in the file."""
    suffix = pathlib.Path(path).suffix.lower()
    if suffix in MESHES:
        remedy = "sample points of what a sensor would see of it"
        raise InputError(path, "a mesh, not a scan", remedy)
    if suffix not in READERS:
        fault = f"suffix {suffix!r} is not a point cloud format"
        raise InputError(path, fault, f"convert it to one of {' '.join(READERS)}")
    table = READERS[suffix](path, max_points, fields)
    points, num_others = table[:, :3], table.shape[1] - 3
    kept, notes = measured(points, are_returns, fields)
    if num_others:
        told = f"the first three unnamed columns are x, y and z; {num_others} more"
        notes["columns"] = f"{told} are left out (unnamed or not numbers)"
    if len(kept) == 0:
        fault = "no finite points" + " other than 0,0,0" * ("no_return" in notes)
        raise InputError(path, fault, "check the sensor or the export")
    return kept, len(points), notes


def measured(
    points: Float[np.ndarray, "N 3"],
    are_returns: bool = True,
    fields: Fields | None = None,
) -> tuple[Float[np.ndarray, "K 3"], dict[str, str]]:
    """Points without those that are not finite and lost returns, which many drivers
    write as 0,0,0, and what to tell of the latter; `fields` lose the same. Of any cloud
    the origin is at most one point, which is not missed."""
    x, y, z = points.T  # one by one: a reduction over rows of three takes long
    kept, notes = np.isfinite(x) & np.isfinite(y) & np.isfinite(z), {}
    lost = (x == 0) & (y == 0) & (z == 0)
    if are_returns and lost.any():
        kept &= ~lost
        count = f"{lost.sum():,} of {len(points):,} points are at 0,0,0"
        notes["no_return"] = f"{count} and count as no return"
    if fields:
        fields |= {name: column[kept] for name, column in fields.items()}
    return points[kept], notes


def rounding(points: Float[np.ndarray, "N 3"]) -> str | None:
    """What to tell of an object with few steps across it (`NUM_STEPS`), as of map
    coordinates in float32; None if there are enough."""
    single = points.astype(np.float32)
    exact = single if (single == points).all() else points
    step = float(np.spacing(np.abs(exact).max()))
    steps = np.ptp(points.astype(np.float64), axis=0).max() / step
    told = f"coordinates are rounded to steps of {step:.2g}, {steps:.0f} across the "
    told += "object: export float64, or subtract an offset first"
    return told if steps < NUM_STEPS else None


def inside(
    points: Float[np.ndarray, "N 3"],
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, " N"]:
    """Which points lie in an axis-aligned box, its faces included."""
    x, y, z = ((points >= lower) & (points <= upper)).T
    return x & y & z


def check_cloud(points: Float[np.ndarray, "N 3"], subject: StrPath) -> None:
    """Raise an InputError about `subject` if the points cannot be completed. They must
    be finite, with an extent above zero and up to 10,000 units, and at least 64 of them
    distinct."""
    if len(points) == 0:
        remedy = "check the scan, and the workspace's units and frame"
        raise InputError(subject, "no points", remedy)
    if not np.isfinite(points).all():
        raise InputError(subject, "some points are not finite", "remove them")
    extent = np.ptp(points.astype(np.float64), axis=0).max()
    if extent == 0:
        raise InputError(subject, "zero extent: all points coincide", "check the scan")
    if extent > MAX_EXTENT:
        fault = f"extent {extent:.6g} is above the limit of {MAX_EXTENT:,.0f} units"
        remedy = "scale it to metres, or crop it to one object (--workspace)"
        raise InputError(subject, fault, remedy)
    distinct = np.unique(points[: 4 * MIN_POINTS], axis=0)
    if len(distinct) < MIN_POINTS:
        distinct = np.unique(points, axis=0)
    if len(distinct) < MIN_POINTS:
        few = f"only {len(distinct)} distinct points"
        fault = f"{few}, at least {MIN_POINTS} are needed"
        remedy = "scan more of the object, or widen the workspace (--workspace)"
        raise InputError(subject, fault, remedy)


def check_in_view(
    points: Float[np.ndarray, "N 3"], camera: Camera, subject: StrPath
) -> None:
    """Raise an InputError about `subject` if the camera sees none of the points."""
    pixel, depth = camera.pixel_of(points)
    remedy = (
        "check that rotation and translation map the cloud's frame to the camera's "
        "(x right, y down, z forward), or omit --camera"
    )
    if not (depth > MIN_DEPTH).any():
        raise InputError(subject, "all points are behind the camera", remedy)
    if not (pixel < camera.height * camera.width).any():
        raise InputError(subject, "no points in the camera's image", remedy)
