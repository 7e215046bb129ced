"""Envelopes of scans, one after the other."""

import dataclasses
import functools
import time
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.envelope.calibration import MarginCalibration
from prism_jax.envelope.carving import (
    Carving,
    CloudView,
    DepthView,
    View,
    carve,
    check_agreement,
    check_conflicts,
    check_robot,
)
from prism_jax.envelope.distance import Distances, Envelope
from prism_jax.envelope.reference import check_reference
from prism_jax.envelope.robot import joints_from_dict
from prism_jax.envelope.surfaces import Method, Seen, see, sensor_name
from prism_jax.envelope.voxels import Grid, label
from prism_jax.geometry.camera import Camera, Vector
from prism_jax.io.errors import InputError
from prism_jax.io.streams.frame import Frame
from prism_jax.streaming.observer import FrameObserver

AROUND = 10
"""Voxels beyond the inflated surfaces that a grid reaches to, unless it is given."""


@dataclasses.dataclass(frozen=True)
class Scanned:
    """What an envelope is made of, in one frame and unit."""

    points: Float[np.ndarray, "N 3"]  # those that are completed
    others: Float[np.ndarray, "M 3"]  # what was measured beside them
    depth: Float[np.ndarray, "H W"] | None  # the whole image, if there is one
    camera: Camera | None  # stands where the sensor did, if that is known
    named: Camera | None  # the depth camera, if there is one
    up: str | Vector  # the direction
    # Points on a known robot's surface; None where none is known.
    robot: Float[np.ndarray, "R 3"] | None
    frame_id: str = ""  # what a recording calls the points' frame

    @functools.cached_property
    def everything(self) -> Float[np.ndarray, "A 3"]:
        """All that was measured."""
        return np.concatenate([self.points, self.others])

    def view(self) -> View:
        """The rays that the sensor measured; InputError if its place is not known."""
        if self.camera is None:
            raise unplaced("the cloud")
        if self.depth is not None:
            return DepthView(self.depth, self.camera)
        return CloudView(self.everything, np.asarray(self.camera.position))


@dataclasses.dataclass(frozen=True)
class MadeEnvelope:
    """The envelope of a scan or a frame."""

    # What it is of, what was completed of that, and the voxels.
    scan: Scanned
    seen: Seen
    envelope: Envelope
    # The points that were asked for with their distances, if any were.
    query: tuple[Float[np.ndarray, "Q 3"], Distances] | None
    shown: dict[str, float] | None  # shares of a reference, as it was checked
    known: dict[str, Any] | None  # as `StreamReport` has it
    seconds: dict[str, float]  # spent on "observe", "complete" and "envelope"
    # Of the frame, in its recording and in nanoseconds; of a scan no number is told.
    number: int | None = None
    timestamp: int = 0


def unplaced(subject: str) -> InputError:
    """What is wrong with a cloud without the place of its sensor."""
    remedy = "set --camera or --eye; of a LiDAR's own points --eye=0,0,0"
    return InputError(subject, "its sensor's place is not known", remedy)


def standing(
    depth: Float[np.ndarray, "H W"] | None,
    camera: Camera | None,
    eye: Float[np.ndarray, "3"] | None,
) -> Camera | None:
    """A camera where the sensor stood: that of a depth image, or one at ``eye``. An
    ``eye`` beside a depth image raises InputError."""
    if eye is None:
        return camera
    if depth is not None:
        raise InputError("--eye", "not supported for depth images", "omit it")
    return Camera(np.eye(3), -eye, np.eye(3), 1, 1)


@dataclasses.dataclass(kw_only=True, eq=False)
class FrameScanner(FrameObserver):
    """Takes from frames what envelopes are made of. A cloud's sensor stands where a
    camera does or at `eye`. Frames of another sensor than the `sensor`, and those whose
    known robot has no base, raise InputError."""

    eye: Float[np.ndarray, "3"] | None = None
    sensor: str | None = None  # what the frames' camera is called; None for any

    def complete(self, frame: Frame) -> Any:
        """What is measured in a frame. One that has too little raises InputError."""
        if self.sensor is not None and sensor_name(frame.camera) != self.sensor:
            fault = f"of sensor {sensor_name(frame.camera)!r}, not {self.sensor!r}"
            raise InputError("the frame", fault, "use one sensor a recording")
        if self.robot is not None and frame.joints is not None:
            joints_from_dict(frame.joints, "the frame", based=True)
        points, robot, up, around, _ = self.observe(frame)
        return Scanned(
            points=points,
            others=points[:0] if around is None else around,
            depth=frame.depth,
            camera=standing(frame.depth, frame.camera, self.eye),
            named=frame.camera,
            up=up,
            robot=None if self.robot is None else robot,
            frame_id=frame.frame_id,
        )


@dataclasses.dataclass(kw_only=True, eq=False)
class FrameEnveloper(FrameScanner):
    """Makes envelopes of frames and of single scans, all in the same way.

    `margin` is the q of the `calibration`, which is for the `method`. `asked` are
    points to give the distances of, `reference` surfaces that stand still. The grid
    fills the bounds; without these it goes around each scan. Frames of another size,
    and those that the robot or the reference contradict, raise InputError.
    """

    completer: Any
    method: Method
    calibration: MarginCalibration
    margin: float
    carving: Carving = dataclasses.field(default_factory=Carving)
    asked: Float[np.ndarray, "Q 3"] | None = None
    reference: Float[np.ndarray, "R 3"] | None = None

    def __post_init__(self):
        self.robot_margin = self.method.robot_margin

    def complete(self, frame: Frame) -> MadeEnvelope:
        """The envelope of a frame. One that has too little raises InputError."""
        start = time.perf_counter()
        scan = super().complete(frame)
        observed = time.perf_counter() - start
        made = self.make(scan)
        seconds = {"observe": observed, **made.seconds}
        return dataclasses.replace(made, seconds=seconds, timestamp=frame.timestamp)

    def make(self, scan: Scanned) -> MadeEnvelope:
        """The scan completed, the voxels around it, and their margin."""
        start = time.perf_counter()
        self.calibration.check_units(scan.points)
        view = scan.view()
        if scan.depth is not None:
            check_agreement(view, scan.points, self.carving)
        if scan.robot is not None:
            check_robot(view, scan.robot, self.carving)
        shown = None
        if self.reference is not None:
            shown = check_reference(view, self.reference, self.carving)
        about = scan.camera, self.method, scan.up, scan.robot, scan.others
        seen = see(self.completer, scan.points, *about)
        known = np.concatenate([seen.robot, seen.part])
        completed = time.perf_counter()
        if self.bounds is not None:
            box = self.bounds.lower, self.bounds.upper
        else:
            held = np.concatenate([scan.points, seen.predicted, known])
            reach = self.margin + AROUND * self.method.voxel
            box = held.min(0) - reach, held.max(0) + reach
        grid = Grid.over(*box, self.method.voxel)
        free = carve(grid, view, self.carving)
        check_conflicts(grid, free, scan.everything)
        state = label(grid, free, seen.measured, seen.predicted, known)
        envelope = Envelope(grid, state, seen.surfaces(), self.margin)
        asked = self.asked
        query = None if asked is None else (asked, envelope.query(asked))
        envelope.taken  # noqa: B018  (kept, and part of the time that this takes)
        done = time.perf_counter()
        seconds = {"complete": completed - start, "envelope": done - completed}
        told = self.follow(seen.known)
        return MadeEnvelope(scan, seen, envelope, query, shown, told, seconds)
