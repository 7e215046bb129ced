"""Scans in the user's frame and units, completed."""

import copy
import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.test_time import Completion, make_adapt
from prism_jax.completion import assembly
from prism_jax.completion.compile_cache import compile_cached
from prism_jax.completion.options import AUTO, CompletionOptions
from prism_jax.completion.weights import (
    load_calibration,
    load_point_errors,
    load_pretrained,
)
from prism_jax.geometry.camera import Camera, Vector
from prism_jax.geometry.visibility import Background, Visibility
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.clouds import check_cloud
from prism_jax.io.errors import InputError
from prism_jax.models.variables import Variables
from prism_jax.preprocessing.observation import Observation, observe, origin_is_sensor
from prism_jax.preprocessing.segmentation.background import sees_scene
from prism_jax.preprocessing.segmentation.scene import SegmentedScene, split_scene
from prism_jax.preprocessing.segmentation.support import find_up, given_up
from prism_jax.preprocessing.visibility_map import seen_among, some_of
from prism_jax.uncertainty.confidence import Calibration
from prism_jax.uncertainty.sigma import PointErrors

if TYPE_CHECKING:
    from prism_jax.registration.library import Found, Library


class Completer:
    """Completes scans with one set of weights.

    The network is compiled at its first use and kept, for the next process also if
    ``compiled_dir`` is given. ``quick`` compiles faster what then runs more slowly, and
    rounds differently: for a few scans. With a
    ``calibration`` every completion has a confidence (``verdict``), with
    ``point_errors`` every point has a sigma. What is one of the ``known`` models of a
    library is completed with that, in its pose; scans are then in metres.
    """

    def __init__(
        self,
        config: PrismConfig,
        variables: Variables,
        compiled_dir: pathlib.Path | None = None,
        calibration: Calibration | None = None,
        point_errors: PointErrors | None = None,
        quick: bool = False,
        known: "Library | None" = None,
    ):
        self.config = config
        self.variables = variables
        self.calibration = calibration
        self.point_errors = point_errors
        self.quick = quick
        self.known = known
        self._compiled_dir = compiled_dir
        self._compiled = {}

    @classmethod
    def from_pretrained(
        cls,
        name_or_path: str = "small",
        compiled_dir: pathlib.Path | None = None,
        quick: bool = False,
        known: "Library | None" = None,
    ) -> "Completer":
        """A completer with released weights, given by name or file."""
        config, variables = load_pretrained(name_or_path)
        judges = load_calibration(name_or_path), load_point_errors(name_or_path)
        return cls(config, variables, compiled_dir, *judges, quick, known)

    def complete(
        self,
        points: Float[np.ndarray, "N 3"],
        camera: Camera | None = None,
        workspace: Workspace | None = None,
        around: Float[np.ndarray, "R 3"] | None = None,
        **options: Any,
    ) -> assembly.CompletedScan:
        """Completes one scan of one object; ``options`` are `CompletionOptions`.

        All arguments share one frame and unit of length; both are free. ``camera``
        gives the sensor position. If it is None, the position is the origin, or an
        estimate if the origin is implausible (`preprocessing.sensor`); the view is
        aimed at the points from there. ``workspace`` is the cube to complete, by
        default taken from the points; points outside it are removed and counted.
        ``around`` holds all other points of the same scan: occluders, support, walls
        and points outside the workspace. No points are added where the sensor looked
        past the object to one of these, and networks that use visibility
        (``uses_visibility``) read them. They only count if the sensor position is
        known. Raises `prism_jax.io.InputError` for clouds of the wrong shape, complex
        or non-finite points, fewer than 64 distinct points, an extent of zero or above
        10,000, and a workspace without volume.
        """
        # Read: check what was given.
        asked = CompletionOptions(**options)
        points = _checked(points)
        around = None if around is None else _checked(around, "around")
        if workspace is None:
            check_cloud(points, "points")
        else:
            _check_workspace(workspace)
        # Frame: turn the object upright, find its workspace, the view and what of it
        # is visible.
        if asked.finds_up:
            rotation = None if camera is None else camera.rotation
            found = find_up(points, _seen_from(points, camera), rotation)
            asked = dataclasses.replace(asked, up=found.vector)
        task = self.task(points, camera, workspace, around, asked)
        # Complete: run the network, with label-free steps first if asked to.
        completion, seconds = self.run(task, asked)
        # Filter, densify, judge, and assemble in the user's frame.
        return self._assemble(task, completion, asked, seconds)

    def complete_scene(
        self,
        points: Float[np.ndarray, "N 3"],
        camera: Camera | None = None,
        scene: SegmentedScene | None = None,
        around: Float[np.ndarray, "R 3"] | None = None,
        **options: Any,
    ) -> assembly.CompletedScene:
        """Completes every object of a scene, each in its own workspace.

        Support planes, walls, outliers and very small objects are removed first
        (`split_scene`, whose result for the same points can be passed in). For each
        object, ``around`` also holds all points of the scene that are not its own.
        Arguments and errors are those of `complete`, except that ``up`` defaults to
        "auto".
        """
        asked = CompletionOptions(**{"up": AUTO, **options})
        points = _checked(points)
        beyond = np.zeros((0, 3)) if around is None else _checked(around, "around")
        check_cloud(points, "points")
        # Segment: find up, the support and the objects.
        if scene is None:
            scene = self.split_scene(points, camera, asked.up)
        up = scene.up if asked.finds_up else given_up(asked.up)
        if asked.finds_up:
            asked = dataclasses.replace(asked, up=up.vector)
        # Complete each object as `complete` does, the rest of the scene around it.
        objects = []
        for number in range(len(scene.num_points)):
            own = scene.object == number
            others = np.concatenate([points[~own], beyond])
            task = self.task(points[own], camera, None, others, asked)
            completion, seconds = self.run(task, asked)
            objects.append(self._assemble(task, completion, asked, seconds))
        # Assemble the scene.
        return assembly.in_one_scene(points, scene.object, objects, scene.planes, *up)

    def split_scene(
        self,
        points: Float[np.ndarray, "N 3"],
        camera: Camera | None = None,
        up: str | Vector = AUTO,
    ) -> SegmentedScene:
        """The object of each point; see `segmentation.scene.split_scene`."""
        rotation = None if camera is None else camera.rotation
        points, up = _checked(points), CompletionOptions(up=up).up
        return split_scene(points, up, _seen_from(points, camera), rotation)

    def task(
        self,
        points: Float[np.ndarray, "N 3"],
        camera: Camera | None = None,
        workspace: Workspace | None = None,
        around: Float[np.ndarray, "R 3"] | None = None,
        options: CompletionOptions = CompletionOptions(),
    ) -> assembly.Task:
        """What the network reads of one object's finite points, and the way back.

        The first step of `complete`, whose arguments these are; up is never "auto".
        """
        model = self.config.model
        sensor = "likely" if camera is None else np.asarray(camera.position)
        frame = model if workspace is None else workspace
        seen = observe(points, sensor, frame, options.up)
        check_cloud(points[seen.inside], "points inside the workspace")
        place = "unknown" if not seen.sensor_known else "origin"
        place = "given" if camera is not None and seen.sensor_known else place
        read = seen.sampled(model.backbone.num_points)
        if workspace is not None and not seen.inside.all():
            outside = points[~seen.inside]
            around = outside if around is None else np.concatenate([outside, around])
        visibility = None
        if around is not None:
            visibility = _visibility(seen, around, options.background)
        return assembly.Task(points, seen, read, read.camera, place, visibility)

    def reads(self, task: assembly.Task) -> tuple[Any, ...]:
        """What the network reads of a task: its points, its view and, if it gains by
        it, what is known of that."""
        model = self.config.model
        reads = model.uses_visibility and model.backbone.reads_visibility
        if task.visibility is None or not reads:
            return task.read.partial, task.view
        return task.read.partial, task.view, task.visibility

    def run(
        self, task: assembly.Task, options: CompletionOptions
    ) -> tuple[Completion, dict[str, float]]:
        """The network's completion of a task, and the seconds it took to compile and to
        run: the second step of `complete`."""
        arguments = (self.variables, *self.reads(task))
        start = time.perf_counter()
        call = self._compile_adapt(options, arguments)
        compiled = time.perf_counter()
        found = jax.block_until_ready(call(*arguments))
        done = time.perf_counter()
        return found, {"compile": compiled - start, "run": done - compiled}

    def in_poses(self, count: int) -> "Completer":
        """The same, which completes in so many poses (`ModelConfig.poses`); what is
        compiled is not shared. In fewer than three there are no verdicts."""
        other = copy.copy(self)
        other.config = self.config.with_model(poses=count)
        other._compiled = {}
        return other

    def knowing(self, known: "Library | None") -> "Completer":
        """The same with another library; what is compiled is shared."""
        other = copy.copy(self)
        other.known = known
        return other

    def _assemble(
        self,
        task: assembly.Task,
        completion: Completion,
        options: CompletionOptions,
        seconds: dict[str, float],
    ) -> assembly.CompletedScan:
        """The completed scan, with all that these weights can say of it."""
        judges = self.config.model.poses, self.calibration, self.point_errors
        done = assembly.assemble(task, completion, options, seconds, *judges)
        if self.known is None:
            return done
        start = time.perf_counter()
        found = self.recognise(task, options)
        done = assembly.with_model(done, task, options, found)
        seconds = {**seconds, "known": time.perf_counter() - start}
        return dataclasses.replace(done, seconds=seconds)

    def recognise(
        self,
        task: assembly.Task,
        options: CompletionOptions,
        before: "Found | None" = None,
    ) -> "Found":
        """Which of the known models an object is, which was found so `before`."""
        assert self.known is not None
        seen, visibility = task.seen, task.visibility
        if visibility is None:
            visibility = _visibility(seen, np.zeros((0, 3)), options.background)
        return self.known.find(
            task.points[seen.inside],
            np.asarray(seen.workspace.from_unit(np.asarray(seen.eye))),
            _to_user(visibility, seen) if seen.sensor_known else None,
            seen.workspace.up,
            before,
        )

    def _compile_adapt(
        self, options: CompletionOptions, arguments: tuple[Any, ...]
    ) -> Callable[..., Any]:
        """The adaptation function, compiled once."""
        steps = self.config.adapt.num_steps if options.adapt else 0
        config = self.config.with_adapt(num_steps=steps)
        # Others than a network that reads it need not be compiled for each background.
        if config.model.backbone.reads_visibility:
            config = config.with_model(background=options.background)
        key = options.adapt, config.model.background, jax.tree.structure(arguments[1:])
        if key not in self._compiled:
            # A kept program is told by what it is about, not by the function itself.
            self._compiled[key] = compile_cached(
                make_adapt(config), arguments, self._compiled_dir, config, self.quick
            )
        return self._compiled[key]


def _visibility(
    seen: Observation, around: Float[np.ndarray, "R 3"], background: Background
) -> Visibility:
    """What the sensor knows of its view of what was observed, in the unit workspace and
    in single precision: the object alone if nobody knows where it stood."""
    beside = some_of(around).astype(np.float64)
    beside = np.asarray(seen.workspace.to_unit(beside))
    if not seen.sensor_known:
        beside = beside[:0]
    eye = np.asarray(seen.eye)
    visibility = seen_among(seen.cloud, beside, eye, Workspace.unit(), background)
    camera = jax.tree.map(lambda array: array.astype(np.float32), visibility.camera)
    return visibility._replace(camera=camera)


def _to_user(visibility: Visibility, seen: Observation) -> Visibility:
    """A map in the unit workspace, for points in the user's frame."""
    camera = seen.camera_to_user(visibility.camera)
    depth = visibility.depth * np.float32(seen.workspace.half_extent)
    return Visibility(camera, np.asarray(visibility.state), depth)


def _seen_from(
    points: np.ndarray, camera: Camera | None
) -> Float[np.ndarray, "3"] | None:
    """Where the sensor of a whole cloud stood, if anything says so."""
    if camera is not None:
        return np.asarray(camera.position, np.float64)
    at_origin = origin_is_sensor(points) or sees_scene(points)
    return np.zeros(3) if at_origin else None


def _checked(points: Any, subject: str = "points") -> Float[np.ndarray, "N 3"]:
    """The points as an array of floats, or InputError about the subject."""
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        remedy = "pass an (N, 3) array, such as points[:, :3]"
        raise InputError(subject, f"invalid shape {points.shape}", remedy)
    if points.dtype.kind not in "fiu":
        remedy = "pass real coordinates, such as points.real"
        raise InputError(subject, f"invalid type {points.dtype}", remedy)
    if points.dtype.kind != "f":
        points = points.astype(np.float64)
    if not np.isfinite(points).all():
        raise InputError(subject, "some points are not finite", "remove them")
    return points


def _check_workspace(workspace: Workspace) -> None:
    """InputError unless it is a cube. `Workspace` itself cannot know under tracing."""
    center, half_extent = np.asarray(workspace.center), workspace.half_extent
    if not (np.isfinite(center).all() and 0 < float(half_extent) < np.inf):
        fault = f"invalid: centre {center}, half_extent {half_extent}"
        raise InputError("workspace", fault, "give finite numbers, half_extent > 0")
