"""Calibrations from recorded cells with their ground truth."""

import hashlib
from collections import defaultdict
from typing import Any

import numpy as np
import tqdm

from prism_jax.data.recordings import DEPTH_SCALE, RecordedCells, RecordedFrame
from prism_jax.envelope.calibration import MarginCalibration, cell_score
from prism_jax.envelope.carving import Carving, DepthView, check_robot
from prism_jax.envelope.robot import joints_from_dict, robot_surface
from prism_jax.envelope.surfaces import Method, Seen, see, sensor_name
from prism_jax.io.clouds import inside
from prism_jax.io.depth import points_from_depth
from prism_jax.io.errors import InputError
from prism_jax.io.scan import Bounds, parted
from prism_jax.io.streams.frame import Joints
from prism_jax.preprocessing.upright import parse_up
from prism_jax.robots.urdf import Linkage


def calibrate_on(
    cells: RecordedCells,
    completer: Any,
    method: Method,
    weights: str,
    alpha: float,
    sensor: str | None = None,
    robot: Linkage | None = None,
    joints: Joints = Joints(),
) -> MarginCalibration:
    """Completes every frame and scores it against the truth in the workspace; of a
    cell, which is a sequence, the worst frame counts.

    `completer` is a `prism_jax.Completer` of the `weights` with that sha256. A known
    robot is where the frames say, or `joints`. `sensor` is what cameras are called, by
    default by their images. Frames without the truth or, where they are needed, joints
    and base, frames of several sensors, and cells with a frame in common raise
    InputError.
    """
    scores: dict[str, float] = defaultdict(float)
    whose: dict[str, str] = {}  # each frame's sequence, by the frame's digest
    sensors, sizes = set(), []
    for index in tqdm.trange(len(cells), desc="frames", disable=None):
        sequence, name = cells.frames[index]
        place, frame = f"{sequence}/{name}", cells.read(index)
        sensors.add(sensor or sensor_name(frame.camera))
        surface = None
        if robot is not None:
            held = dict(joints.given or frame.joints or {})
            held |= {} if joints.base is None else {"base": joints.base}
            posed = joints_from_dict(held, place, based=True)
            surface = robot_surface(robot, *posed, path=place)
            view = DepthView(frame.depth * DEPTH_SCALE, frame.camera)
            check_robot(view, surface, Carving())
        points, seen, truth = seen_in(frame, completer, method, surface, place)
        score = cell_score(truth, seen.surfaces())
        scores[sequence] = max(scores[sequence], score)
        sizes.append(float(np.linalg.norm(np.ptp(points, axis=0))))
        data = frame.depth.tobytes() + frame.partial.tobytes()
        other = whose.setdefault(hashlib.sha256(data).hexdigest(), sequence)
        if other != sequence:
            fault = f"{sequence} has a frame of {other}"
            raise InputError(cells.root, fault, "record each cell once")
    if len(sensors) > 1:
        fault = f"frames of several sensors: {'; '.join(sorted(map(str, sensors)))}"
        raise InputError(cells.root, fault, "calibrate each sensor separately")
    # The digests in falling order, so that each cell's least one stays.
    least = {whose[digest]: digest for digest in sorted(whose, reverse=True)}
    return MarginCalibration(
        method.setup(weights, str(sensors.pop())),
        alpha,
        tuple(scores),
        tuple(least[sequence] for sequence in scores),
        tuple(scores.values()),
        (min(sizes), max(sizes)),
    )


def seen_in(
    frame: RecordedFrame, completer: Any, method: Method, robot: Any, place: str
) -> tuple[np.ndarray, Seen, np.ndarray]:
    """What of a frame is completed, what is known then, and the true surface in the
    workspace; InputError about `place` without that. `robot` are points on the surface
    of one that is known."""
    if frame.complete is None:
        raise InputError(place, "no complete cloud", "add the ground truth")
    metres = frame.depth * DEPTH_SCALE
    image = points_from_depth(metres, frame.depth > 0, frame.camera)
    points, truth = image if method.input == "depth" else frame.partial, frame.complete
    others = [image] if method.input == "both" else []
    if method.workspace is not None:
        corners = np.reshape(method.workspace, (2, 3))
        points, around = parted(points, Bounds(*corners), place)
        others += [] if around is None else [around]
        truth = truth[inside(truth, *corners)]
    beside = np.concatenate([np.zeros((0, 3)), *others])
    known = parse_up(method.up), robot, beside
    return points, see(completer, points, frame.camera, method, *known), truth
