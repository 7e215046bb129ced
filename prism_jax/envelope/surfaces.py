"""From a scan to surfaces: what was measured, what is predicted, and the robot where it
is known."""

import dataclasses
import json
import math
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float64

from prism_jax.envelope.calibration import Setup
from prism_jax.envelope.distance import KINDS, Surfaces
from prism_jax.envelope.robot import ROBOT_MARGIN, of_robot
from prism_jax.envelope.voxels import VOXEL
from prism_jax.geometry.camera import Camera, Vector
from prism_jax.io.clouds import check_cloud
from prism_jax.io.errors import InputError
from prism_jax.io.ply import COMPLETED

Input = Literal["both", "cloud", "depth"]
"""What is measured: a cloud and its depth image, a cloud alone, an image alone."""


PART_MARGIN = 0.06
"""In its longest sides: so near to what was found lay all of the true surface of 19 of
20 validation parts (docs/findings.md). Calibrations hold for one value: with another
`registration.library.VERSION` has to rise, which tells libraries apart."""


@dataclasses.dataclass(frozen=True)
class Method:
    """How scans are read and completed for envelopes. A calibration holds for one."""

    input: Input = "both"
    up: str = "z"  # as `preprocessing.upright.parse_up` reads it, or "auto"
    # The box that scans are cropped to and the voxels fill, x0,y0,z0,x1,y1,z1; None for
    # whatever there is.
    workspace: tuple[float, ...] | None = None
    voxel: float = VOXEL
    adapt: bool = False  # whether the network adapts to the scan
    # As `prism_jax.Completer.complete` has them.
    density: float = 1.0
    background: Literal["unknown", "empty"] = "unknown"
    # Which robot is known, by `envelope.robot.robot_digest`; None if none is.
    robot: str | None = None
    # How near to the robot's surface measured points are its own.
    robot_margin: float = ROBOT_MARGIN
    # The models that are known, by `registration.library.Library.digest`.
    known: str | None = None

    def setup(self, weights: str, sensor: str) -> Setup:
        """What a calibration of this method is for."""
        return Setup(weights, sensor, json.loads(json.dumps(dataclasses.asdict(self))))


@dataclasses.dataclass(frozen=True)
class Seen:
    """What is known of one scan, in its frame and unit."""

    # Points that a margin is laid around, without a known robot's.
    measured: Float64[np.ndarray, "N 3"]
    # Points that are added to them; none within a known robot's margin.
    predicted: Float64[np.ndarray, "P 3"]
    # Points on its surface, where it is known.
    robot: Float64[np.ndarray, "R 3"]
    part: Float64[np.ndarray, "M 3"]  # and on the surface of a known part
    fault: str = ""  # why nothing could be completed; empty if something was
    known: Any = None  # as `prism_jax.completion.assembly.CompletedScan` has it

    def surfaces(self) -> Surfaces:
        """What a margin inflates."""
        size = self.known.model.surface.size if len(self.part) else 0.0
        points = {kind: getattr(self, kind) for kind in KINDS}
        return Surfaces(points, PART_MARGIN * float(size))


def see(
    completer: Any,
    points: Float[np.ndarray, "N 3"],
    camera: Camera | None,
    method: Method,
    up: str | Vector = "z",
    robot: Float[np.ndarray, "R 3"] | None = None,
    others: Float[np.ndarray, "S 3"] | None = None,
) -> Seen:
    """Completes a scan, with the robot cut out of what is measured and put back.

    `completer` is a `prism_jax.Completer`; points, camera, the points of the robot's
    surface and `others`, what was measured beside the scan, are in one frame. Where
    nothing can be completed nothing is predicted, and `Seen.fault` says why. A robot
    where the method knows none, and none where it does, raise InputError.
    """
    if (robot is not None) != (method.robot is not None):
        told = "missing" if robot is None else "not part of the calibration"
        raise InputError("the robot", told, "use --urdf as in the calibration")
    points = np.asarray(points, np.float64)
    robot = np.zeros((0, 3)) if robot is None else np.asarray(robot, np.float64)
    others = np.zeros((0, 3)) if others is None else np.asarray(others, np.float64)
    points = points[~of_robot(points, robot, method.robot_margin)]
    others = others[~of_robot(others, robot, method.robot_margin)]
    predicted, part, known, fault = np.zeros((0, 3)), np.zeros((0, 3)), None, ""
    try:
        check_cloud(points, "the scan")
        named = "adapt", "density", "background"
        asked = {name: getattr(method, name) for name in named}
        done = completer.complete(points, camera, up=up, **asked)
    except InputError as error:
        fault = str(error)
    else:
        known = done.known
        predicted = np.asarray(done.points[done.label == COMPLETED], np.float64)
        predicted = predicted[~of_robot(predicted, robot, method.robot_margin)]
        if known is not None and known.model is not None:
            part = known.placed()[0]
    measured = np.concatenate([points, others])
    return Seen(measured, predicted, robot, part, fault, known)


def sensor_name(camera: Camera | None) -> str | None:
    """What a depth camera is called by its image; None without one.

    Size and fields of view, in whole degrees: units of one make are the same.
    """
    if camera is None:
        return None
    size = np.array([camera.width, camera.height])
    focal = np.diag(np.asarray(camera.intrinsics))[:2]
    wide, high = (2 * math.degrees(math.atan(t)) for t in 0.5 * size / focal)
    return f"camera {camera.width}x{camera.height}, {wide:.0f}x{high:.0f} degrees"
