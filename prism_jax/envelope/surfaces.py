"""From a scan to surfaces: what was measured of objects, what is predicted of them, and
the robot where it is known."""

import dataclasses
import math
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float64

from prism_jax.envelope.calibration import Setup
from prism_jax.envelope.distance import Surfaces
from prism_jax.envelope.robot import ROBOT_MARGIN, of_robot
from prism_jax.geometry.camera import Camera, Vector
from prism_jax.io.clouds import check_cloud
from prism_jax.io.errors import InputError
from prism_jax.preprocessing.segmentation.scene import SUPPORT

FLOOR = 0.05
"""Metres: no scale of a margin is smaller, and what is not predicted has this one."""

THIN = 0.02
"""Metres: of what was measured beside a scan, a cube this wide keeps one point."""


@dataclasses.dataclass(frozen=True)
class Method:
    """How scans are completed for envelopes. A calibration holds for one."""

    adapt: bool = False  # whether the network adapts to the scan
    # As `prism_jax.Completer.complete` has them.
    density: float = 1.0
    background: Literal["unknown", "empty"] = "unknown"
    # "one" for all points as one object, "auto" for a scene whose supports and walls
    # are set aside.
    objects: Literal["one", "auto"] = "one"
    # What of the measured a margin is laid around: "everything", or "objects" alone,
    # without what was set aside or is beside the scan in its depth image.
    around: Literal["everything", "objects"] = "everything"
    robot: Literal["known", "unknown"] = "unknown"  # whether the robot is known
    # How near to the robot's surface measured points are its own.
    robot_margin: float = ROBOT_MARGIN
    # What is completed where the robot is known: "all" measured points, or the "rest"
    # without it.
    completed: Literal["all", "rest"] = "rest"

    def setup(self, weights: str, sensor: str) -> Setup:
        """What a calibration of this method is for."""
        return Setup(weights, sensor, dataclasses.asdict(self))


@dataclasses.dataclass(frozen=True)
class Seen:
    """What is known of one scan, in its frame and unit."""

    # Points that a margin is laid around, without a known robot's.
    measured: Float64[np.ndarray, "N 3"]
    # Points that are added to them; none within a known robot's margin.
    predicted: Float64[np.ndarray, "P 3"]
    # Points on its surface; none where it is not known.
    robot: Float64[np.ndarray, "R 3"]
    # The error that is expected of each predicted point; None where the weights tell
    # none.
    sigma: Float64[np.ndarray, " P"] | None
    fault: str = ""  # why nothing could be completed; empty if something was

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
            fault = "no per-point errors"
            raise InputError("the weights", fault, "omit --scaled")
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
    others: Float[np.ndarray, "S 3"] | None = None,
) -> Seen:
    """Completes a scan, with the robot cut out of what is measured and put back.

    `completer` is a `prism_jax.Completer`; points, camera, the points of the robot's
    surface and `others`, all that was measured beside the scan, are in one frame. Where
    too little is left to be completed nothing is predicted, and `Seen.fault` says so. A
    robot where the method knows none, and none where it does, raise InputError.
    """
    if (robot is not None) != (method.robot == "known"):
        told = "missing" if robot is None else "not part of the calibration"
        raise InputError("the robot", told, "use --urdf as in the calibration")
    points = np.asarray(points, np.float64)
    robot = np.zeros((0, 3)) if robot is None else np.asarray(robot, np.float64)
    others = np.zeros((0, 3)) if others is None else thinned(others)
    own = of_robot(points, robot, method.robot_margin)
    asked = points[~own] if method.completed == "rest" else points
    objects, predicted, sigma, fault = points[~own], np.zeros((0, 3)), np.zeros(0), ""
    try:
        check_cloud(asked, "the scan")
    except InputError as error:
        fault = str(error)
    else:
        done, aside = _completed(completer, asked, camera, method, up)
        predicted = np.asarray(done.points[~done.observed], np.float64)
        apart = ~of_robot(predicted, robot, method.robot_margin)
        predicted, sigma = predicted[apart], getattr(done, "sigma", None)
        if sigma is not None:
            sigma = np.asarray(sigma, np.float64)[~done.observed][apart]
        set_aside = own.copy()
        set_aside[slice(None) if len(asked) == len(points) else ~own] |= aside
        objects = points[~set_aside]
        others = np.concatenate([others, points[set_aside & ~own]])
    if method.around == "everything":
        others = others[~of_robot(others, robot, method.robot_margin)]
        objects = np.concatenate([objects, others])
    return Seen(objects, predicted, robot, sigma, fault)


def thinned(points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "M 3"]:
    """The first point in each cube of side `THIN`, in their order."""
    points = np.asarray(points, np.float64)
    cubes = np.floor(points / THIN).astype(int)
    return points[np.sort(np.unique(cubes, axis=0, return_index=True)[1])]


def _completed(
    completer: Any,
    points: Float64[np.ndarray, "N 3"],
    camera: Camera | None,
    method: Method,
    up: str | Vector,
) -> tuple[Any, Bool[np.ndarray, " N"]]:
    """What the completer makes of points, and which of them lie on planes that were set
    aside."""
    settings = {
        "adapt": method.adapt,
        "up": up,
        "density": method.density,
        "background": method.background,
    }
    if method.objects == "one":
        done = completer.complete(points, camera, **settings)
        return done, np.zeros(len(points), bool)
    scene = completer.split_scene(points, camera, up)
    done = completer.complete_scene(points, camera, scene=scene, **settings)
    return done, scene.object == SUPPORT


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
