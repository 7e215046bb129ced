"""What real scans there are in a folder, and how each is given to a completer.

Some come with more: the true shape, labels of the things in them, a box about the
object, or what another network predicts of them.
"""

import pathlib
import zipfile
from collections.abc import Callable, Mapping
from functools import partial
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int

from prism_jax import io
from prism_jax.completed import CompletedScan, CompletedScene
from prism_jax.data.public.kitti import read_corners
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import Background
from prism_jax.io.files import read_bytes, unsound
from prism_jax.io.pcd import read_pcd, read_pcd_field
from prism_jax.io.streams import open_stream
from prism_jax.observation.scene import SUPPORT
from prism_jax.result import score

MIN_POINTS = 500
"""Labelled things of no more points are not compared."""

REACH = 6.0
"""Metres from a LiDAR, beyond which its points are left away."""

GROWN = 1.1
"""A labelled box is so many times as long, wide and high before points are outside."""

AT_ORIGIN = Camera(np.eye(3), np.zeros(3), np.eye(3), height=1, width=1)
"""A LiDAR's points are in its own frame. All around it as they are, nothing about them
says so."""

Done = CompletedScan | CompletedScene
Check = Callable[[Done], dict[str, float]]


class Given(NamedTuple):
    """A scan as it is given to a completer, and what is known of it.

    Attributes:
      points: the finite ones, in the file's units and frame.
      camera: the sensor's, where the file has one.
      truth: the whole shape in the same frame, or None.
      checks: what else a completion can be held against, by the names of `CHECKS`.
    """

    points: Float64[np.ndarray, "N 3"]
    camera: Camera | None = None
    truth: Float[np.ndarray, "T 3"] | None = None
    checks: Mapping[str, Check] = {}


class Spec(NamedTuple):
    """A scan of the folder.

    Attributes:
      name: in tables.
      file: its place in the folder.
      read: takes the path, and raises InputError where there is nothing to read.
      up: what the completer is told of the direction that points upwards.
      is_scene: whether there are several objects, to be taken apart first.
      is_drawn: whether its licence lets everyone show and change pictures of it.
      background: what the completer is told of it.
    """

    name: str
    file: str
    read: Callable[[pathlib.Path], Given]
    up: str
    is_scene: bool = False
    is_drawn: bool = True
    background: Background = "unknown"


class Told(NamedTuple):
    """How a table shows what a check says."""

    label: str
    factor: float


CHECKS = {
    "overlap": Told(f"IoU of each labelled thing of more than {MIN_POINTS} points", 1),
    "outside_box": Told("% of points outside the labelled box grown by 10 %", 100),
    "to_peer": Told(
        "CD-L2 x1e4 to a published network's output, which is no truth", 1e4
    ),
}
"""Their names, as results have them."""


def scanned(path: pathlib.Path) -> Given:
    """A cloud, or a depth image with its camera beside it."""
    scan = io.read_scan(path)
    return Given(scan.points.astype(np.float64), scan.camera)


def scanned_in_frame(path: pathlib.Path, member: str) -> Given:
    """One of the scans of an NPZ that were moved into the frame of `complete`."""
    data = BytesIO(read_bytes(path))
    try:
        arrays = np.load(data, allow_pickle=False)
        points, truth = arrays[member], arrays["complete"]
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        kind = f"an NPZ of {member} and complete"
        raise unsound(path, kind, error, "copy it again") from None
    return Given(points.astype(np.float64), truth=truth)


def labelled(path: pathlib.Path) -> Given:
    """A cloud, or a depth image, of things that the PCD of the same name tells apart:
    what has most points is what they stand on."""
    points, labels = labelled_scan(str(path.with_suffix(".pcd")))
    given = scanned(path)
    if len(given.points) != len(points):
        fault = f"has {len(given.points):,} points, and its labels {len(points):,}"
        raise io.InputError(path, fault, "put the PCD of the same frame beside it")
    return given._replace(checks={"overlap": partial(overlap, labels)})


def boxed(path: pathlib.Path) -> Given:
    """A cloud with the eight corners of its object's box in the .txt of its name."""
    corners = read_corners(path.with_suffix(".txt"))
    return scanned(path)._replace(checks={"outside_box": partial(outside, corners)})


def with_peer(path: pathlib.Path, peer: str) -> Given:
    """A cloud, and what another network predicts of it in a file beside it."""
    predicted = io.read_points(path.with_name(peer))
    return scanned(path)._replace(checks={"to_peer": partial(to_peer, predicted)})


def swept(path: pathlib.Path) -> Given:
    """The points of a LiDAR within `REACH`."""
    return Given(near(scanned(path).points), AT_ORIGIN)


def captured(path: pathlib.Path) -> Given:
    """The first whole frame of a LiDAR's recording, within `REACH`."""
    stream, lacking = open_stream(path), 0
    for frame in stream:
        if stream.remarks["incomplete"] == lacking:
            return Given(near(frame.points.astype(np.float64)), AT_ORIGIN)
        lacking = stream.remarks["incomplete"]
    raise io.InputError(path, "has no whole frame", "check how it was recorded")


def near(points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "M 3"]:
    """Those within `REACH` of the origin; a point at it is no return."""
    distance = np.linalg.norm(points, axis=1)
    return points[(distance > 0) & (distance < REACH)]


def labelled_scan(
    path: str,
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, " N"]]:
    """The finite points of a PCD, and whose they are by its field `label`."""
    points, label = read_pcd(path), read_pcd_field(path, "label")
    finite = np.isfinite(points).all(axis=1)
    _, kinds, counts = np.unique(label[finite], return_inverse=True, return_counts=True)
    if len(counts) < 2:
        remedy = "label what things stand on and each of them"
        raise io.InputError(path, "has fewer than two labels", remedy)
    order = np.argsort(-counts, kind="stable")
    number = np.empty(len(counts), int)
    number[order] = np.arange(len(counts)) + SUPPORT
    return points[finite], number[kinds]


def overlap(labels: Int[np.ndarray, " N"], done: Done) -> dict[str, float]:
    """Intersection over union of each labelled thing with the object that has most in
    common with it."""
    assert isinstance(done, CompletedScene)
    found = done.object[done.observed]
    objects = [found == number for number in range(found.max() + 1)]
    best = []
    for thing in (labels == number for number in range(labels.max() + 1)):
        if thing.sum() > MIN_POINTS:
            shares = [(thing & one).sum() / (thing | one).sum() for one in objects]
            best.append(max(shares, default=0.0))
    return {f"thing {number}": float(iou) for number, iou in enumerate(best)}


def outside(corners: Float64[np.ndarray, "8 3"], done: Done) -> dict[str, float]:
    """Shares of the measured and of the added points outside the grown box.

    From corner 0, edges lead to the corners 1, 3 and 4.
    """
    edges = corners[[1, 3, 4]] - corners[0]
    along = np.linalg.solve(edges.T, (done.points - corners[0]).T).T
    is_outside = (np.abs(along - 0.5) > GROWN / 2).any(axis=1)
    parts = {"measured": done.observed, "added": ~done.observed}
    return {k: float(is_outside[v].mean()) for k, v in parts.items() if v.any()}


def to_peer(predicted: Float[np.ndarray, "P 3"], done: Done) -> dict[str, float]:
    """CD-L2 of each cloud to what another network predicts, which is no truth."""
    scores: dict[str, Any] = score(done, predicted)["clouds"]
    return {name: scored["cd_l2"] for name, scored in scores.items()}


_SCAN_000 = partial(scanned_in_frame, member="scan_000")
_SCAN_090 = partial(scanned_in_frame, member="scan_090")
_BUNNY, _KINECT = "bunny/pairs.npz", "kinect/mosd_test24"
_PLANE = "shapenet/airplane_partial_2048.ply"
_PEER = partial(with_peer, peer="airplane_predicted_16384.ply")


def and_alone(spec: Spec) -> tuple[Spec, Spec]:
    """A scan of one object and nothing else, without and with that told."""
    return spec, spec._replace(name=f"{spec.name}, alone", background="empty")


SPECS = (
    *and_alone(Spec("bunny, scan_000", _BUNNY, _SCAN_000, "y")),
    *and_alone(Spec("bunny, scan_090", _BUNNY, _SCAN_090, "y")),
    *and_alone(Spec("bunny, raw", "bunny/raw_scan_000.ply", scanned, "y")),
    Spec("Kinect, cloud", f"{_KINECT}.pcd", labelled, "auto", is_scene=True),
    Spec("Kinect, depth image", f"{_KINECT}.png", labelled, "auto", is_scene=True),
    Spec("KITTI, car", "kitti/frame_0_car_0.pcd", boxed, "z", is_drawn=False),
    *and_alone(Spec("ShapeNet, airplane", _PLANE, _PEER, "y", is_drawn=False)),
    Spec("Ouster, sweep", "ouster/single_frame_zm_scan0.npz", swept, "z", True),
    Spec(
        "Ouster, capture", "ouster/OS-0-128-U1_v2.3.0_1024x10.pcap", captured, "z", True
    ),
)


def check_folder(folder: pathlib.Path) -> None:
    """Raises InputError, which says what is expected, if there is no such folder."""
    if not folder.is_dir():
        files = ", ".join(dict.fromkeys(spec.file for spec in SPECS))
        remedy = f"name a folder of real scans, with {files}"
        raise io.InputError("--data_dir", f"{folder} is no folder", remedy)
