"""Completes frames as scans, without what takes time beside."""

import dataclasses
import time
from typing import Any

import numpy as np
from jaxtyping import Bool

from prism_jax.completion.assembly import join, of_model
from prism_jax.completion.completer import Completer
from prism_jax.completion.options import CompletionOptions
from prism_jax.envelope.robot import of_robot
from prism_jax.geometry.visibility import Background
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.clouds import check_cloud, inside
from prism_jax.io.ply import COMPLETED, KNOWN, OBSERVED
from prism_jax.io.streams.frame import Frame
from prism_jax.io.streams.sinks import Labelled
from prism_jax.preprocessing.observation import compile_sampling
from prism_jax.streaming.observer import FrameObserver


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompletedFrame(Labelled):
    """A completed frame, in the frame and unit of its measured points: those inside the
    workspace, exactly as they were, then the predicted ones where nothing was measured,
    and points on a known robot's surface. `run_stream` gives it its number."""

    workspace: Workspace  # the cube that was completed
    seconds: dict[str, float]  # spent on "observe", "network" and "assemble"
    known: dict[str, Any] | None = None  # as `StreamReport` has it

    @property
    def observed(self) -> Bool[np.ndarray, " M"]:
        """True for a measured point."""
        return self.label == OBSERVED


@dataclasses.dataclass(kw_only=True, eq=False)
class FrameCompleter(FrameObserver):
    """Completes frames as `Completer.complete` completes scans, and nothing else: no
    verdict, no depth map and, unless `density` asks for it, no resampling.

    `poses` is one for speed; in as many as the weights say the points are those of
    scans, bit for bit. A known robot is put back as points on its surface, with nothing
    predicted within its margin. The rest is as for `FrameObserver`.
    """

    completer: Completer = dataclasses.field(kw_only=False)
    adapt: bool = False
    density: float = 0.0
    background: Background = "unknown"
    poses: int = 1

    def __post_init__(self):
        self.options = CompletionOptions(self.adapt, "z", self.density, self.background)
        if self.completer.config.model.poses != self.poses:
            self.completer = self.completer.in_poses(self.poses)

    def complete(self, frame: Frame) -> CompletedFrame:
        """The frame completed. One that has too little raises InputError."""
        start = time.perf_counter()
        points, robot, up, around, rows = self.observe(frame)
        if self.robot is not None:
            check_cloud(points, "the frame without its robot")
        options = dataclasses.replace(self.options, up=up)
        task = self.completer.task(points, frame.camera, None, around, options)
        observed = time.perf_counter()
        completion, seconds = self.completer.run(task, options)
        ran = time.perf_counter()
        workspace = task.seen.workspace
        joined = join(task, completion.points, options)
        points, measured, known = joined.points, joined.observed, None
        if self.completer.known is not None:
            found = self.completer.recognise(task, options, self.found)
            known = self.follow(found)
            if known is not None:
                own = points[measured]
                points, measured, *_ = of_model(task, own, options, found)
        added = COMPLETED if known is None else KNOWN
        label = np.where(measured, OBSERVED, added).astype(np.uint8)
        # The robot's surface comes behind them, and within its margin nothing is added.
        if self.bounds is not None:
            robot = robot[inside(robot, self.bounds.lower, self.bounds.upper)]
        kept = measured | ~of_robot(points, robot, self.robot_margin)
        points = np.concatenate([points[kept], robot.astype(points.dtype)])
        label = np.append(label[kept], np.full(len(robot), KNOWN, np.uint8))
        rows = rows[task.seen.inside]
        return CompletedFrame(
            number=0,
            points=points,
            label=label,
            workspace=workspace,
            timestamp=frame.timestamp,
            seconds={
                "observe": observed - start,
                "network": ran - observed - seconds["compile"],
                "assemble": time.perf_counter() - ran,
            },
            frame_id=frame.frame_id,
            fields={name: column[rows] for name, column in frame.fields.items()},
            known=known,
        )

    def warm_up(self, frame: Frame) -> CompletedFrame:
        """The frame completed, and all compiled for others of at most as many points.
        Nothing is compiled then while frames are completed, unless one is larger."""
        num_points = self.completer.config.model.backbone.num_points
        compile_sampling(num_points, len(frame.points))
        return super().warm_up(frame)
