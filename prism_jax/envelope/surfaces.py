"""From a scan to surfaces: what was measured of objects, what is predicted of them, and
the robot where it is known."""

import dataclasses
import math
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float64

from prism_jax.envelope.calibration import Setup
from prism_jax.envelope.distance import Surfaces
from prism_jax.envelope.robot import MARGIN, of_robot
from prism_jax.geometry.camera import Camera, Vector
from prism_jax.io.clouds import check_cloud
from prism_jax.io.errors import InputError

FLOOR = 0.05
"""Metres: no scale of a margin is smaller, and what is not predicted has this one."""


@dataclasses.dataclass(frozen=True)
class Method:
    """How scans are completed for envelopes. A calibration holds for one.

    Attributes:
      adapt: whether the network adapts to the scan.
      density, background: as `prism_jax.Completer.complete` has them.
      objects: "one" for all points as one object, "auto" for a scene whose supports and
        walls are set aside; these are voxels, but no margin is laid around them.
      robot: whether the robot is known.
      robot_margin: how near to its surface measured points are its own.
      completed: what is completed where the robot is known: "all" measured points, or
        the "rest" without it.
    """

    adapt: bool = False
    density: float = 1.0
    background: Literal["unknown", "empty"] = "unknown"
    objects: Literal["one", "auto"] = "one"
    robot: Literal["known", "unknown"] = "unknown"
    robot_margin: float = MARGIN
    completed: Literal["all", "rest"] = "rest"

    def setup(self, weights: str, sensor: str) -> Setup:
        """What a calibration of this method is for."""
        return Setup(weights, sensor, dataclasses.asdict(self))


@dataclasses.dataclass(frozen=True)
class Seen:
    """What is known of one scan, in its frame and unit.

    Attributes:
      measured: points of objects, without a known robot's.
      predicted: points that are added to them; none within a known robot's margin.
      robot: points on its surface; none where it is not known.
      sigma: the error that is expected of each predicted point; None where the weights
        tell none.
      set_aside: measured points of planes that objects stand on, and of walls.
      fault: why nothing could be completed; empty if something was.
    """

    measured: Float64[np.ndarray, "N 3"]
    predicted: Float64[np.ndarray, "P 3"]
    robot: Float64[np.ndarray, "R 3"]
    sigma: Float64[np.ndarray, " P"] | None
    set_aside: Float64[np.ndarray, "S 3"]
    fault: str = ""

    def surfaces(self, floor: float | None = None) -> Surfaces:
        """What a margin inflates; with a `floor`, in scales of the expected error.

        Where the weights tell no error, scales raise InputError.
        """
        points = {
            "measured": self.measured,
            "robot": self.robot,
            "predicted": self.predicted,
        }
        if floor is None:
            return Surfaces(points)
        if self.sigma is None:
            fault = "tell no error of a point"
            raise InputError("the weights", fault, "leave out --scaled")
        scales = {kind: np.full(len(cloud), floor) for kind, cloud in points.items()}
        scales["predicted"] = np.maximum(self.sigma, floor)
        return Surfaces(points, scales)


def see(
    completer: Any,
    points: Float[np.ndarray, "N 3"],
    camera: Camera | None,
    method: Method,
    up: str | Vector = "z",
    robot: Float[np.ndarray, "R 3"] | None = None,
) -> Seen:
    """Completes a scan, with the robot cut out of what is measured and put back.

    `completer` is a `prism_jax.Completer`; points, camera and the points of the robot's
    surface are in one frame. Where too little is left to be completed nothing is
    predicted, and `Seen.fault` says so. A robot where the method knows none, and none
    where it does, raise InputError.
    """
    if (robot is not None) != (method.robot == "known"):
        told = "is missing" if robot is None else "is given, and none was calibrated"
        raise InputError("the robot", told, "give --urdf and --joints, or neither")
    points = np.asarray(points, np.float64)
    robot = np.zeros((0, 3)) if robot is None else np.asarray(robot, np.float64)
    rest = points[~of_robot(points, robot, method.robot_margin)]
    asked = rest if method.completed == "rest" else points
    nothing, aside = np.zeros((0, 3)), np.zeros((0, 3))
    try:
        check_cloud(asked, "the scan")
    except InputError as error:
        return Seen(rest, nothing, robot, np.zeros(0), aside, str(error))
    settings = {
        "adapt": method.adapt,
        "up": up,
        "density": method.density,
        "background": method.background,
    }
    if method.objects == "auto":
        scene = completer.split_scene(asked, camera, up)
        done = completer.complete_scene(asked, camera, scene=scene, **settings)
        aside = asked[scene.object == -1]
        aside = aside[~of_robot(aside, robot, method.robot_margin)]
        rest = asked[scene.object != -1]
        rest = rest[~of_robot(rest, robot, method.robot_margin)]
    else:
        done = completer.complete(asked, camera, **settings)
    predicted = np.asarray(done.points[~done.observed], np.float64)
    apart = ~of_robot(predicted, robot, method.robot_margin)
    sigma = getattr(done, "sigma", None)
    if sigma is not None:
        sigma = np.asarray(sigma, np.float64)[~done.observed][apart]
    return Seen(rest, predicted[apart], robot, sigma, aside)


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
