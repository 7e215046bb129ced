"""Scans in the user's frame and units, completed."""

import dataclasses
import pathlib
import time
from typing import Any

import jax
import jax.export
import numpy as np
from jaxtyping import Array, Bool, Float

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.objective import Losses
from prism_jax.adaptation.test_time import Completion, make_adapt
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.render import render_depth
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.clouds import check_cloud
from prism_jax.io.errors import InputError
from prism_jax.models.variables import Variables
from prism_jax.observation.observation import Observation, observe, padded
from prism_jax.selection import densify, select, surface_density
from prism_jax.trace_cache import compile_cached
from prism_jax.weights import load_pretrained

DEPTH_PIXELS = 128

_render = jax.jit(render_depth)

for kind in (Completion, Losses):
    name = f"prism_jax.{kind.__name__}"
    jax.export.register_namedtuple_serialization(kind, serialized_name=name)


@dataclasses.dataclass(frozen=True)
class CompletedScan:
    """A completed scan, in the user's frame and units.

    Attributes:
      points: the measured points inside the workspace, exactly as given, and then the
        predicted points where nothing was measured.
      observed: True for a measured point.
      prediction: the network's own output, all of it.
      left_away: how many predicted points are not among the added ones, and why:
        "outside" the workspace, a "stray", "in_front" of what was measured, or "known"
        (`prism_jax.selection`). One can be counted twice.
      left_out: how many measured points lie outside the workspace: strays, far from
        all others, unless the workspace was given. They are not among the points.
      accepted: whether the adapted completion is the one returned
        (`prism_jax.adaptation.test_time.Completion` says what that means).
      losses: the terms of Eq. 13 before each step and after the last.
      weights: of normals, denoising and alignment in them.
      workspace: the cube that was completed.
      camera: the view that depths were compared in.
      sensor: where it stands: "given", at the "origin", or "unknown".
      depth_observed, mask_observed: the measured points in that view.
      depth_completed, mask_completed: the completed ones.
      seconds: spent on compiling and on running.
    """

    points: Float[np.ndarray, "M 3"]
    observed: Bool[np.ndarray, " M"]
    prediction: Float[np.ndarray, "P 3"]
    left_out: int
    left_away: dict[str, int]
    accepted: bool
    losses: dict[str, list[float]]
    weights: Float[np.ndarray, "3"]
    workspace: Workspace
    camera: Camera
    sensor: str
    depth_observed: Float[np.ndarray, "H W"]
    mask_observed: Bool[np.ndarray, "H W"]
    depth_completed: Float[np.ndarray, "H W"]
    mask_completed: Bool[np.ndarray, "H W"]
    seconds: dict[str, float]


class Completer:
    """Weights and what is compiled for them.

    The function of one configuration is compiled at its first use and kept. Its trace
    is kept in ``trace_dir``, if one is given, for the next process.
    """

    def __init__(
        self,
        config: PrismConfig,
        variables: Variables,
        trace_dir: pathlib.Path | None = None,
    ):
        self.config = config
        self.variables = variables
        self._trace_dir = trace_dir
        self._compiled = {}

    @classmethod
    def from_pretrained(
        cls, name_or_path: str = "small", trace_dir: pathlib.Path | None = None
    ) -> "Completer":
        """A completer with released weights, by name or by file."""
        return cls(*load_pretrained(name_or_path), trace_dir)

    def complete(
        self,
        points: Float[np.ndarray, "N 3"],
        camera: Camera | None = None,
        workspace: Workspace | None = None,
        adapt: bool = True,
        up: str = "z",
        density: float = 1.0,
    ) -> CompletedScan:
        """Completes one scan.

        Points are in any unit of length and any frame, the same for all arguments.
        ``camera`` says where the sensor stood. If it is None, that is the origin, or
        obliquely above if the origin cannot be its place (`prism_jax.observation`). The
        view is aimed at the points from there, so that its pixels are spent on them.
        ``workspace`` is the cube to complete, taken from the points if it is None;
        points outside are left out and counted. ``adapt=False`` leaves out test-time
        adaptation. ``up`` is the axis of the user's frame that points upwards (x, y, z,
        -x, -y or -z; -y for a camera's): the weights know upright objects. Added points
        are ``density`` times as dense as the measured ones where the network's output
        is a surface, and never sparser than that; 0 leaves them as predicted.
        Points of another shape, complex or not finite, fewer than 64 distinct ones, an
        extent of zero or above 10,000, and a workspace without volume raise
        `prism_jax.io.InputError`.
        """
        points = _checked(points)
        if workspace is None:
            check_cloud(points, "points")
        else:
            _check_workspace(workspace)
        sensor = "origin" if camera is None else np.asarray(camera.position)
        model = self.config.model
        seen = observe(points, sensor, workspace, model.margin, up, model.heading)
        measured, unit = points[seen.inside], np.asarray(seen.partial)[seen.inside]
        check_cloud(measured, "points inside the workspace")
        read = seen.sampled(model.backbone.num_points)
        view = read.camera
        completion, seconds = self._run(adapt, read.partial, view)
        prediction = np.asarray(completion.points, np.float64)
        eye = np.asarray(seen.eye) if seen.sensor_known else None
        selection = select(prediction, unit, read.partial, eye)
        kept = _dense(prediction[selection.kept], unit, density)
        added = seen.workspace.from_unit(kept).astype(points.dtype)
        together = np.concatenate([measured, added])
        return CompletedScan(
            points=together,
            observed=np.arange(len(together)) < len(measured),
            prediction=np.asarray(seen.workspace.from_unit(prediction)),
            left_out=len(points) - len(measured),
            left_away={
                reason: int(which.sum())
                for reason, which in selection._asdict().items()
                if reason != "kept"
            },
            accepted=bool(completion.accepted),
            losses={
                name: np.asarray(values, np.float64).tolist()
                for name, values in completion.losses._asdict().items()
            },
            weights=np.asarray(completion.weights),
            workspace=seen.workspace,
            camera=seen.camera_to_user(view),
            sensor=_told(camera, seen),
            **_depth_maps(unit, kept, view, seen.workspace),
            seconds=seconds,
        )

    def _run(
        self, adapt: bool, partial: Array | np.ndarray, view: Camera
    ) -> tuple[Completion, dict[str, float]]:
        start = time.perf_counter()
        arguments = (self.variables, partial, view)
        if adapt not in self._compiled:
            steps = self.config.adapt.num_steps if adapt else 0
            config = self.config.with_adapt(num_steps=steps)
            fn = make_adapt(config)
            if self._trace_dir is None:
                call = jax.jit(fn).lower(*arguments).compile()
            else:
                call = compile_cached(fn, arguments, self._trace_dir, config)
            self._compiled[adapt] = call
        compiled = time.perf_counter()
        completion = self._compiled[adapt](*arguments)
        completion = jax.block_until_ready(completion)
        done = time.perf_counter()
        return completion, {"compile": compiled - start, "run": done - compiled}


def _dense(
    added: np.ndarray, measured: np.ndarray, density: float
) -> Float[np.ndarray, "Q 3"]:
    """The added points, between them so many more as a density is asked for."""
    if density < 0 or not np.isfinite(density):
        fault = f"cannot be {density}"
        raise InputError("density", fault, "give 0 or a number of times, as 1")
    if density == 0:
        return added
    predicted = surface_density(added)
    if predicted == 0:
        return added
    dense = densify(added, density * surface_density(measured) / predicted)
    return dense[(np.abs(dense) <= 1.0).all(axis=1)]


def _checked(points: Any) -> Float[np.ndarray, "N 3"]:
    """The points as an array of floats, or InputError."""
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        remedy = "pass an (N, 3) array, such as points[:, :3]"
        raise InputError("points", f"have the shape {points.shape}", remedy)
    if points.dtype.kind not in "fiu":
        remedy = "pass real coordinates, such as points.real"
        raise InputError("points", f"are of the type {points.dtype}", remedy)
    if points.dtype.kind != "f":
        points = points.astype(np.float64)
    if not np.isfinite(points).all():
        raise InputError("points", "has points that are not finite", "drop them")
    return points


def _check_workspace(workspace: Workspace) -> None:
    """InputError unless it is a cube. `Workspace` itself cannot know under tracing."""
    center, half_extent = np.asarray(workspace.center), workspace.half_extent
    if not (np.isfinite(center).all() and 0 < float(half_extent) < np.inf):
        fault = f"is no cube: its centre is {center}, its half_extent {half_extent}"
        raise InputError("workspace", fault, "give finite numbers, the latter positive")


def _told(camera: Camera | None, seen: Observation) -> str:
    """`CompletedScan.sensor`."""
    if not seen.sensor_known:
        return "unknown"
    return "origin" if camera is None else "given"


def _depth_maps(
    measured: np.ndarray, added: np.ndarray, view: Camera, workspace: Workspace
) -> dict[str, np.ndarray]:
    """Depth of the measured and of all points, in the user's units."""
    view = view.resized(DEPTH_PIXELS, DEPTH_PIXELS)
    maps = {}
    clouds = {"observed": measured, "completed": np.concatenate([measured, added])}
    for name, cloud in clouds.items():
        depth, mask = _render(padded(cloud).astype(np.float32), view)
        maps[f"depth_{name}"] = np.asarray(depth) * workspace.half_extent
        maps[f"mask_{name}"] = np.asarray(mask)
    return maps
