"""Calibrations from recorded cells with their ground truth."""

import numpy as np
import tqdm
from jaxtyping import Float

from prism_jax.data.recordings import DEPTH_SCALE, RecordedCells
from prism_jax.envelope.calibration import MarginCalibration, cell_score
from prism_jax.envelope.robot import joints_from_dict, robot_surface
from prism_jax.envelope.surfaces import FLOOR, Method, Seen, see, sensor_name
from prism_jax.io.depth import points_from_depth
from prism_jax.io.errors import InputError
from prism_jax.robots.urdf import Linkage


def calibrate_on(
    cells: RecordedCells,
    completer,
    method: Method,
    robot: Linkage | None,
    weights: str,
    alpha: float,
    sensor: str | None = None,
) -> MarginCalibration:
    """Completes every frame and scores it against the truth; of a cell, which is a
    sequence, the worst frame counts.

    `completer` is a `prism_jax.Completer` of the `weights` with that sha256. Where the
    robot is known its positions are the frames' own. `sensor` is what cameras are
    called, by default by their images. Frames without the truth or, where they are
    needed, the joints, and frames of several sensors raise InputError.
    """
    scores: dict[str, np.ndarray] = {}
    sensors = set()
    for index in tqdm.trange(len(cells), desc="frames", disable=None):
        sequence, name = cells.frames[index]
        frame = cells.read(index)
        if frame.complete is None:
            fault = "no complete cloud"
            raise InputError(f"{sequence}/{name}", fault, "add the ground truth")
        sensors.add(sensor or sensor_name(frame.camera))
        surface = None
        if robot is not None:
            joints = joints_from_dict(frame.joints or {}, f"{sequence}/{name}.joints")
            surface = robot_surface(robot, *joints)
        metres = frame.depth * DEPTH_SCALE
        others = points_from_depth(metres, frame.depth > 0, frame.camera)
        known = surface, others
        seen = see(completer, frame.partial, frame.camera, method, "z", *known)
        before = scores.get(sequence, np.zeros(2))
        scores[sequence] = np.maximum(before, frame_scores(frame.complete, seen))
    if len(sensors) > 1:
        fault = f"frames of several sensors: {'; '.join(sorted(map(str, sensors)))}"
        raise InputError(cells.root, fault, "calibrate each sensor separately")
    margins, scaled = np.stack(list(scores.values())).T
    told = not np.isnan(scaled).any()
    return MarginCalibration(
        method.setup(weights, str(sensors.pop())),
        alpha,
        tuple(scores),
        tuple(margins.tolist()),
        tuple(scaled.tolist()) if told else None,
        FLOOR if told else None,
    )


def frame_scores(truth: Float[np.ndarray, "N 3"], seen: Seen) -> Float[np.ndarray, "2"]:
    """The margin that a frame needs, and that in scales of the points' own errors: NaN
    where the weights tell none."""
    scaled = np.nan
    if seen.sigma is not None:
        scaled = cell_score(truth, seen.surfaces(FLOOR))
    return np.array([cell_score(truth, seen.surfaces()), scaled])
