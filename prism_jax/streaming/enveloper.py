"""Envelopes of scans, one after the other."""

import dataclasses
import time
from typing import Any

import numpy as np
from jaxtyping import Float

from prism_jax.envelope.carving import (
    Carving,
    View,
    carve,
    check_agreement,
    check_conflicts,
    view_of_cloud,
    view_of_depth,
)
from prism_jax.envelope.distance import Distances, Envelope
from prism_jax.envelope.robot import of_robot
from prism_jax.envelope.surfaces import Method, Seen, see
from prism_jax.envelope.voxels import VOXEL, Grid, label
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
    everything: Float[np.ndarray, "M 3"]  # all that was measured
    depth: Float[np.ndarray, "H W"] | None  # the whole image, if there is one
    camera: Camera | None  # stands where the sensor did, if that is known
    named: Camera | None  # the depth camera, if there is one
    up: str | Vector  # the direction
    # Points on a known robot's surface; None where none is known.
    robot: Float[np.ndarray, "R 3"] | None


@dataclasses.dataclass(frozen=True)
class MadeEnvelope:
    """The envelope of a scan or a frame."""

    # What it is of, what was completed of that, and the voxels.
    scan: Scanned
    seen: Seen
    envelope: Envelope
    # The points that were asked for with their distances, if any were.
    query: tuple[Float[np.ndarray, "Q 3"], Distances] | None
    seconds: dict[str, float]  # spent on "observe", "complete" and "envelope"
    # Of the frame, in its recording and in nanoseconds; of a scan no number is told.
    number: int | None = None
    timestamp: int = 0

    def numbered(self, number: int) -> "MadeEnvelope":
        """The frame of that number, as sinks take it."""
        return dataclasses.replace(self, number=number)


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


@dataclasses.dataclass(eq=False)
class FrameEnveloper(FrameObserver):
    """Makes envelopes of frames and of single scans, all in the same way.

    `margin` is the q of a calibration for the `method`, in scales of the points' own
    errors where a `floor` is given. Of clouds, what was measured through is free only
    where their sensor's place is told, by a camera or by `eye`. `asked` are points to
    tell the distances of. The grid fills the bounds; without these it goes around each
    scan.
    """

    completer: Any
    method: Method
    margin: float
    floor: float | None = None
    voxel: float = VOXEL
    carving: Carving = dataclasses.field(default_factory=Carving)
    eye: Float[np.ndarray, "3"] | None = None
    asked: Float[np.ndarray, "Q 3"] | None = None

    def __post_init__(self):
        self.robot_margin = self.method.robot_margin

    def complete(self, frame: Frame) -> MadeEnvelope:
        """The envelope of a frame. One that has too little raises InputError."""
        start = time.perf_counter()
        points, robot, up, _ = self.observe(frame)
        scan = Scanned(
            points=points,
            everything=frame.points,
            depth=frame.depth,
            camera=standing(frame.depth, frame.camera, self.eye),
            named=frame.camera,
            up=up,
            robot=None if self.robot is None else robot,
        )
        observed = time.perf_counter() - start
        made = self.make(scan)
        seconds = {"observe": observed, **made.seconds}
        return dataclasses.replace(made, seconds=seconds, timestamp=frame.timestamp)

    def make(self, scan: Scanned) -> MadeEnvelope:
        """The scan completed, the voxels around it, and their margin."""
        start = time.perf_counter()
        known = scan.camera, self.method, scan.up, scan.robot, scan.everything
        seen = see(self.completer, scan.points, *known)
        completed = time.perf_counter()
        surfaces = seen.surfaces(self.floor)
        if self.bounds is not None:
            grid = Grid.over(self.bounds.lower, self.bounds.upper, self.voxel)
        else:
            held = np.concatenate([scan.points, seen.predicted, seen.robot])
            reach = surfaces.reach(self.margin) + AROUND * self.voxel
            grid = Grid.over(held.min(0) - reach, held.max(0) + reach, self.voxel)
        free = np.zeros(grid.shape, bool)
        own = of_robot(scan.everything, seen.robot, self.method.robot_margin)
        measured = scan.everything[~own]
        view = _view(scan)
        if view is not None:
            check_agreement(view, scan.points, self.carving)
            free = carve(grid, view, self.carving)
            check_conflicts(grid, free, scan.everything)
        state = label(grid, free, measured, seen.predicted, seen.robot)
        envelope = Envelope(grid, state, surfaces, self.margin)
        asked = self.asked
        query = None if asked is None else (asked, envelope.query(asked))
        envelope.taken  # noqa: B018  (kept, and part of the time that this takes)
        done = time.perf_counter()
        seconds = {"complete": completed - start, "envelope": done - completed}
        return MadeEnvelope(scan, seen, envelope, query, seconds)


def _view(scan: Scanned) -> View | None:
    """The rays that the sensor measured, if its place is known."""
    if scan.camera is None:
        return None
    if scan.depth is not None:
        return view_of_depth(scan.depth, scan.depth > 0, scan.camera)
    return view_of_cloud(scan.everything, np.asarray(scan.camera.position))
