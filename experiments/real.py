"""Completes every real scan of a folder, and scores those with ground truth.

    python -m experiments.real --data_dir=../shared/real --weights=small \
        --output=docs/tables/real.json

Some come with the true shape, labels, a box around the object, or the output of another
network. Scans that cannot be read are skipped, with a line on stderr.
"""

import pathlib
import sys
from collections.abc import Callable, Mapping
from functools import partial
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
from absl import flags
from jaxtyping import Float, Float64
from tqdm import tqdm

from experiments.output import prepare_output
from experiments.run_folder import commit
from experiments.scoring import print_and_write
from experiments.weights import located
from prism_jax import io
from prism_jax.cli.launch import launch
from prism_jax.completion.assembly import CompletedScan, CompletedScene
from prism_jax.completion.completer import Completer
from prism_jax.evaluation.metrics import UNIT
from prism_jax.evaluation.tables import table_lines
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import Background
from prism_jax.io.files import read_bytes
from prism_jax.io.pcd import read_pcd
from prism_jax.io.streams import open_stream
from prism_jax.io.text import read_text
from prism_jax.reporting.summary import score

FLAGS = flags.FLAGS

MIN_POINTS = 500  # labelled things of no more points are not compared
LIDAR_RANGE = 6.0  # metres from a LiDAR, beyond which its points are left out
GROWN = 1.1  # of a labelled box, before points count as outside
# The sensor of LiDARs, whose points are in its own frame and all around it.
AT_ORIGIN = Camera(np.eye(3), np.zeros(3), np.eye(3), height=1, width=1)

Done = CompletedScan | CompletedScene


class Given(NamedTuple):
    """A scan's finite points, in the file's units and frame, the sensor's camera, the
    whole shape, and what else a completion can be compared with, by name."""

    points: Float64[np.ndarray, "N 3"]
    camera: Camera | None = None
    truth: Float[np.ndarray, "T 3"] | None = None
    checks: Mapping[str, Callable[[Done], dict[str, float]]] = {}


class Spec(NamedTuple):
    """A scan of the folder: its name in tables, its file, what reads that, and what the
    completer is told. A scene has several objects, to be taken apart first."""

    name: str
    file: str
    read: Callable[[pathlib.Path], Given]
    up: str
    is_scene: bool = False
    background: Background = "unknown"


def scanned(path: pathlib.Path) -> Given:
    """A cloud, or a depth image with its camera beside it."""
    scan = io.read_scan(path)
    return Given(scan.points.astype(np.float64), scan.camera)


def scanned_in_frame(member: str, path: pathlib.Path) -> Given:
    """One of the scans of an NPZ that were moved into the frame of `complete`."""
    with np.load(BytesIO(read_bytes(path)), allow_pickle=False) as arrays:
        return Given(arrays[member].astype(np.float64), truth=arrays["complete"])


def labelled(path: pathlib.Path) -> Given:
    """A cloud, or a depth image, of things that the field `label` in the PCD of the
    same name tells apart: what has most points is what they stand on. The check is the
    intersection over union of each thing with the object that is most like it."""
    pcd, given = str(path.with_suffix(".pcd")), scanned(path)
    fields: dict[str, np.ndarray] = {}
    finite = np.isfinite(read_pcd(pcd, fields=fields)).all(axis=1)
    if len(given.points) != finite.sum():
        fault = f"{len(given.points):,} points, but {finite.sum():,} labels"
        raise io.InputError(path, fault, "add the PCD of the same frame")
    label = fields["label"][finite]
    names, counts = np.unique(label, return_counts=True)
    things = [label == name for name in names[np.argsort(-counts, kind="stable")][1:]]

    def overlap(done: Done) -> dict[str, float]:
        assert isinstance(done, CompletedScene)
        found, best = done.object[done.observed], []
        objects = [found == number for number in range(found.max() + 1)]
        for thing in (thing for thing in things if thing.sum() > MIN_POINTS):
            shares = [(thing & one).sum() / (thing | one).sum() for one in objects]
            best.append(float(max(shares, default=0.0)))
        return {f"thing {number}": iou for number, iou in enumerate(best)}

    return given._replace(checks={"overlap": overlap})


def boxed(path: pathlib.Path) -> Given:
    """A cloud with the eight corners of its object's box in the .txt of its name. The
    check has the shares of measured and of added points outside the grown box."""
    corners = read_corners(path.with_suffix(".txt"))
    edges = corners[[1, 3, 4]] - corners[0]  # which lead to these corners

    def outside(done: Done) -> dict[str, float]:
        along = np.linalg.solve(edges.T, (done.points - corners[0]).T).T
        is_outside = (np.abs(along - 0.5) > GROWN / 2).any(axis=1)
        parts = {"measured": done.observed, "added": ~done.observed}
        return {k: float(is_outside[v].mean()) for k, v in parts.items() if v.any()}

    return scanned(path)._replace(checks={"outside_box": outside})


def with_peer(path: pathlib.Path) -> Given:
    """A cloud, and what another network predicts of it in a file beside it; the check
    is the CD-L2 of each cloud to that, which is no truth."""
    predicted = io.read_points(path.with_name("airplane_predicted_16384.ply"))

    def to_peer(done: Done) -> dict[str, float]:
        scores: dict[str, Any] = score(done, predicted)["clouds"]
        return {name: scored["cd_l2"] for name, scored in scores.items()}

    return scanned(path)._replace(checks={"to_peer": to_peer})


def swept(path: pathlib.Path) -> Given:
    """The points of a LiDAR within `LIDAR_RANGE`."""
    return Given(near(scanned(path).points), AT_ORIGIN)


def captured(path: pathlib.Path) -> Given:
    """The first whole frame of a LiDAR's recording, within `LIDAR_RANGE`."""
    stream, lacking = open_stream(path), 0
    for frame in stream:
        if stream.remarks["incomplete"] == lacking:
            return Given(near(frame.points.astype(np.float64)), AT_ORIGIN)
        lacking = stream.remarks["incomplete"]
    raise io.InputError(path, "no complete frame", "check how it was recorded")


def read_corners(path: pathlib.Path) -> Float64[np.ndarray, "8 3"]:
    """The corners of a car's box; InputError of anything else. From corner 0 edges lead
    to 1, 3 and 4, and that to 3 is the heading."""
    corners = read_text(path)
    is_box = corners.shape == (8, 3) and bool(np.isfinite(corners).all())
    if not is_box or np.array_equal(corners[0, :2], corners[3, :2]):
        fault = "not the eight corners of a box"
        raise io.InputError(path, fault, "copy this file again from the data set")
    return corners


def near(points: np.ndarray) -> np.ndarray:
    """Those within `LIDAR_RANGE` of the origin; a point at it is no return."""
    distance = np.linalg.norm(points, axis=1)
    return points[(distance > 0) & (distance < LIDAR_RANGE)]


def and_alone(spec: Spec) -> tuple[Spec, Spec]:
    """A scan of one object and nothing else, without and with that told."""
    return spec, spec._replace(name=f"{spec.name}, alone", background="empty")


_SCAN_000, _SCAN_090 = (partial(scanned_in_frame, m) for m in ("scan_000", "scan_090"))
_PLANE = "shapenet/airplane_partial_2048.ply"
_CAPTURE = "ouster/OS-0-128-U1_v2.3.0_1024x10.pcap"

SPECS = (
    *and_alone(Spec("bunny, scan_000", "bunny/pairs.npz", _SCAN_000, "y")),
    *and_alone(Spec("bunny, scan_090", "bunny/pairs.npz", _SCAN_090, "y")),
    *and_alone(Spec("bunny, raw", "bunny/raw_scan_000.ply", scanned, "y")),
    Spec("Kinect, cloud", "kinect/mosd_test24.pcd", labelled, "auto", True),
    Spec("Kinect, depth image", "kinect/mosd_test24.png", labelled, "auto", True),
    Spec("KITTI, car", "kitti/frame_0_car_0.pcd", boxed, "z"),
    *and_alone(Spec("ShapeNet, airplane", _PLANE, with_peer, "y")),
    Spec("Ouster, sweep", "ouster/single_frame_zm_scan0.npz", swept, "z", True),
    Spec("Ouster, capture", _CAPTURE, captured, "z", True),
)


def row_of(completer: Completer, spec: Spec, scan: Given) -> dict[str, Any]:
    """What the result says of a scan that is completed as a user's is."""
    asked = scan.points, scan.camera
    if spec.is_scene:
        scene = completer.split_scene(*asked, up=spec.up)
        done = completer.complete_scene(*asked, up=spec.up, scene=scene)
    else:
        done = completer.complete(*asked, up=spec.up, background=spec.background)
    objects = done.objects if isinstance(done, CompletedScene) else [done]
    verdicts = [one.verdict for one in objects if one.verdict is not None]
    outside = 0
    for one in objects:
        unit = np.asarray(one.workspace.to_unit(one.points[~one.observed]))
        outside += int((np.abs(unit) > 1 + 1e-6).any(axis=1).sum())  # but for rounding
    return {
        "scan": spec.name,
        "weights": FLAGS.weights,
        "up": spec.up,
        "background": spec.background,
        "points": len(scan.points),
        "objects": len(objects),
        "added": int((~done.observed).sum()),
        "outside": outside,
        "strays": sum(one.left_away["stray"] for one in objects),
        "verdicts": [
            {"trust": v.trust, "expected_error": float(v.expected_error)}
            for v in verdicts
        ],
        "scores": None if scan.truth is None else score(done, scan.truth),
        "checks": {name: check(done) for name, check in scan.checks.items()},
    }


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_string("data_dir", "../shared/real", "Folder of the real scans.")
    flags.DEFINE_string("weights", "small", "Weights, name or file.")
    flags.DEFINE_string("output", None, "JSON file to write.")


def main() -> None:
    """Completes, scores, prints the table and writes the result."""
    prepare_output(FLAGS.output, ".json")
    given, left_out = {}, {}
    for spec in SPECS:
        try:
            given[spec] = spec.read(pathlib.Path(FLAGS.data_dir, spec.file))
        except io.InputError as error:
            left_out[spec.name] = str(error)
            print(f"skipped {spec.name}: {error}", file=sys.stderr)
    if not given:
        raise io.InputError(FLAGS.data_dir, "none of the scans found", "see above")
    completer = Completer.from_pretrained(located(FLAGS.weights))
    rows = [row_of(completer, spec, scan) for spec, scan in tqdm(given.items())]
    result = {"commit": commit(), "unit": UNIT, "left_out": left_out, "scans": rows}
    head = ["scan", "points", "objects", "added", "outside", "strays", "confidence"]
    cells = []
    for row in rows:
        trust = ", ".join(verdict["trust"] for verdict in row["verdicts"])
        cells.append([row["scan"], *(f"{row[n]:,}" for n in head[1:-1]), trust])
    print_and_write(result, "\n".join(table_lines(head, cells)))


def run() -> None:
    """The entry point."""
    define_flags()
    launch("real", main)


if __name__ == "__main__":
    run()
