"""What frames hold for completing, whatever is made of them."""

import abc
import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from prism_jax.envelope.robot import (
    ROBOT_MARGIN,
    joints_from_dict,
    of_robot,
    robot_surface,
)
from prism_jax.geometry.camera import Vector
from prism_jax.io.clouds import check_cloud, inside
from prism_jax.io.errors import InputError
from prism_jax.io.scan import Bounds, in_own_axes, parted
from prism_jax.io.streams.frame import Frame
from prism_jax.preprocessing.segmentation.support import find_up
from prism_jax.robots.urdf import Linkage

ALIKE = 0.003  # in longest sides: poses of one place differ by as much


def default_up(frame: Frame) -> str:
    """-y for a depth image in its camera's axes and a cloud in an optical frame, else
    z."""
    optical = frame.frame_id.endswith("_optical_frame")
    if frame.depth is not None:
        optical = frame.camera is not None and in_own_axes(frame.camera)
    return "-y" if optical else "z"


class Observed(NamedTuple):
    """What a frame holds for completing: `points` measured inside the bounds and not
    the robot's, points on the surface of a `robot` that is known, what was measured
    `around`, if bounds or a known robot set anything apart, and which `rows` of the
    frame's points are among `points`."""

    points: Float[np.ndarray, "N 3"]
    robot: Float[np.ndarray, "R 3"]
    up: str | Vector
    around: Float[np.ndarray, "S 3"] | None
    rows: Int[np.ndarray, " N"]


@dataclasses.dataclass(kw_only=True, eq=False)
class FrameObserver(abc.ABC):
    """Frames of one sensor as scans, whatever is made of each.

    ``bounds`` crop each frame first. Without an ``up`` it is -y for a depth image in
    its camera's axes and a cloud in a `*_optical_frame`, and else z; "auto" looks for
    it in the first frame and keeps it.
    Of a ``robot`` that is known, points within ``robot_margin`` of where the frame's
    joints put it are cut out.
    """

    bounds: Bounds | None = None
    up: str | Vector | None = None
    robot: Linkage | None = None
    robot_margin: float = ROBOT_MARGIN
    # The known model in the last frame that held one, as a `Found` of its library.
    found: Any = dataclasses.field(default=None, init=False)

    @abc.abstractmethod
    def complete(self, frame: Frame) -> Any:
        """What is made of a frame. One that has too little raises InputError."""

    def warm_up(self, frame: Frame) -> Any:
        """The same of a first frame, for what it compiles."""
        return self.complete(frame)

    def observe(self, frame: Frame) -> Observed:
        """The frame's points, those of its robot apart; InputError if it has none, or
        if its joints are missing."""
        points, around = frame.points, None
        rows = np.arange(len(points))
        if self.bounds is not None and len(points):
            rows = rows[inside(points, self.bounds.lower, self.bounds.upper)]
            points, around = parted(points, self.bounds, "the frame")
        check_cloud(points, "the frame")
        robot = np.zeros((0, 3))
        if self.robot is not None:
            if frame.joints is None:
                remedy = "record joint states, or give them with --joints"
                raise InputError("the frame", "no joint positions", remedy)
            robot = robot_surface(self.robot, *joints_from_dict(frame.joints))
        own = of_robot(points, robot, self.robot_margin)
        if self.robot is not None:
            # Seen or not: what is told must not depend on it, or more is compiled.
            apart = [points[own]] if around is None else [around, points[own]]
            around = np.concatenate(apart)
        points = points[~own]
        up = self._up(frame, points)
        return Observed(points, robot, up, around, rows[~own])

    def follow(self, found: Any) -> dict[str, Any] | None:
        """What `StreamReport` says of the model in the next frame, if it is one, and
        how far its middle has moved since the last: 0 within what poses are good to."""
        if found is None or found.model is None:
            return None
        before, self.found = self.found, found
        moved = 0.0
        if before is not None and found.model is before.model:
            matches, surface = (found.match, before.match), found.model.surface
            one, other = (m.pose[:3] @ [*surface.middle, 1.0] for m in matches)
            away = float(np.linalg.norm(one - other))
            # In less the two poses may differ by chance.
            variance = sum(m.covariance[3:, 3:].trace() for m in matches)
            good = 3 * variance**0.5 + ALIKE * surface.size
            moved = away if away > good else 0.0
        return {**found.told(), "refused": {}, "moved": moved}

    def _up(self, frame: Frame, points: np.ndarray) -> str | Vector:
        if self.up is None:
            return default_up(frame)
        if isinstance(self.up, str) and self.up == "auto":
            eye, rotation = np.zeros(3), None
            if frame.camera is not None:
                eye = np.asarray(frame.camera.position, np.float64)
                rotation = frame.camera.rotation
            self.up = find_up(points, eye, rotation).vector
        return self.up
