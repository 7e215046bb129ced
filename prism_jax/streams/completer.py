"""Completes frames as scans, without what takes time beside."""

import dataclasses
import time
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from prism_jax.completed import join
from prism_jax.completion import Completer
from prism_jax.geometry.camera import Vector
from prism_jax.geometry.visibility import Background
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.clouds import check_cloud
from prism_jax.io.scan import Bounds, crop, in_own_axes
from prism_jax.io.streams.frame import Frame
from prism_jax.observation.accumulation import Accumulator
from prism_jax.observation.observation import compile_sampling
from prism_jax.observation.support import find_up

Adapt = Literal["off", "first", "every"]


@dataclasses.dataclass(frozen=True)
class CompletedFrame:
    """A completed frame, in the frame and unit of its measured points.

    Attributes:
      points: the measured points inside the workspace, exactly as they were, and then
        the predicted points where nothing was measured.
      observed: True for a measured point.
      remembered: how many of the observed points, the last ones, were measured in
        earlier frames and are hidden now. 0 without an accumulator.
      workspace: the cube that was completed.
      timestamp: the measurement's, in nanoseconds.
      seconds: spent on "observe", "network" and "assemble".
    """

    points: Float[np.ndarray, "M 3"]
    observed: Bool[np.ndarray, " M"]
    workspace: Workspace
    timestamp: int
    seconds: dict[str, float]
    remembered: int = 0


class FrameCompleter:
    """Completes frames as `Completer.complete` completes scans, and nothing else.

    There is no verdict, no depth map and, unless ``density`` asks for it, no
    resampling; the points are the same, bit for bit. ``bounds`` crop each frame first.
    ``adapt`` "off" takes the network as it is, "every" adapts it to each frame, and
    "first" to the first, whose encoders are then kept. ``up`` and the rest are as for
    `Completer.complete`. Without an ``up`` it is -y for a depth image in its camera's
    axes and else z; "auto" looks for it in the first frame and keeps it. With an
    ``accumulator``, for a sensor that does not move, a frame also has what earlier ones
    measured where something hides it now, so that it is not predicted again.
    """

    def __init__(
        self,
        completer: Completer,
        *,
        bounds: Bounds | None = None,
        adapt: Adapt = "off",
        up: str | Vector | None = None,
        density: float = 0.0,
        background: Background = "unknown",
        accumulator: Accumulator | None = None,
    ):
        self.accumulator = accumulator
        self.bounds = bounds
        self.adapt: Adapt = adapt
        self.up = up
        self.density = density
        self.background: Background = background
        self._completer = completer
        self._adapted = False

    def complete(self, frame: Frame) -> CompletedFrame:
        """The frame completed. One that has too little raises InputError."""
        start = time.perf_counter()
        points = frame.points
        if len(points):
            points = crop(points, self.bounds, "the frame")
        check_cloud(points, "the frame")
        points, remembered = self._with_memory(frame, points)
        task = self._completer.task(points, frame.camera, None, self._up(frame, points))
        observed = time.perf_counter()
        steps = self.adapt == "every" or (self.adapt == "first" and not self._adapted)
        reads = self.background, task.read.partial, task.view
        if steps:
            completion, seconds = self._completer.run(True, *reads)
            predicted = completion.points
            if self.adapt == "first":
                self._completer = self._completer.with_encoders(completion.encoders)
                self._adapted = True
        else:
            predicted, seconds = self._completer.predict(*reads)
        ran = time.perf_counter()
        joined = join(
            points, task.seen, task.read, predicted, self.density, self.background
        )
        return CompletedFrame(
            points=joined.points,
            observed=joined.observed,
            remembered=int(task.seen.inside[len(points) - remembered :].sum()),
            workspace=task.seen.workspace,
            timestamp=frame.timestamp,
            seconds={
                "observe": observed - start,
                "network": ran - observed - seconds["compile"],
                "assemble": time.perf_counter() - ran,
            },
        )

    def warm_up(self, frame: Frame) -> CompletedFrame:
        """The frame completed, and all compiled for others of at most as many points.

        Nothing is compiled then while frames are completed, unless one is larger.
        """
        num_points = self._completer.config.model.backbone.num_points
        compile_sampling(num_points, len(frame.points))
        accumulator, self.accumulator = self.accumulator, None
        try:
            return self.complete(frame)
        finally:
            self.accumulator = accumulator

    def _with_memory(
        self, frame: Frame, points: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "M 3"], int]:
        """The points, then those that the frame lacks, and how many these are."""
        if self.accumulator is None:
            return points, 0
        lacking = self.accumulator.add(points, frame.points, _place(frame))
        return np.concatenate([points, lacking.astype(points.dtype)]), len(lacking)

    def _up(self, frame: Frame, points: np.ndarray) -> str | Vector:
        if self.up is None:
            camera = None if frame.depth is None else frame.camera
            return "-y" if camera is not None and in_own_axes(camera) else "z"
        if isinstance(self.up, str) and self.up == "auto":
            rotation = None if frame.camera is None else frame.camera.rotation
            self.up = find_up(points, _place(frame), rotation).vector
        return self.up


def _place(frame: Frame) -> Float[np.ndarray, "3"]:
    """Where the frame's sensor stood."""
    camera = frame.camera
    return np.zeros(3) if camera is None else np.asarray(camera.position, np.float64)
