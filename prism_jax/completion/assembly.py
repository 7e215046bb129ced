"""Completed scans and scenes, in the user's frame and units."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from prism_jax.adaptation.test_time import Completion
from prism_jax.completion.filtering import (
    MAX_DENSE,
    NEW,
    Selection,
    added_points,
    densify,
)
from prism_jax.completion.options import CompletionOptions
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.geometry.render import render_depth
from prism_jax.geometry.visibility import Visibility
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.clouds import rounding
from prism_jax.io.ply import COMPLETED, KNOWN, OBSERVED
from prism_jax.preprocessing.observation import Observation, padded
from prism_jax.preprocessing.segmentation.background import sees_scene
from prism_jax.preprocessing.segmentation.planes import Plane
from prism_jax.preprocessing.sensor import is_closed
from prism_jax.uncertainty.confidence import CLOSED, SCENE, Calibration, Verdict
from prism_jax.uncertainty.evidence import evidence_of, pose_predictions, roughness
from prism_jax.uncertainty.sigma import PointErrors, clues_of, spread

if TYPE_CHECKING:
    from prism_jax.registration.library import Found

DEPTH_PIXELS = 128

UNNOTICED = "a small or hidden change of a known part goes unnoticed: look at the model"

_render = jax.jit(render_depth)


@dataclasses.dataclass(frozen=True)
class CompletedScan:
    """A completed scan, in the user's frame and units.

    Attributes:
      points: the measured points inside the workspace, exactly as given, and then the
        predicted points where nothing was measured.
      observed: True for a measured point.
      prediction: the network's own output, all of it.
      left_away: how many predicted points are not among the added ones, and why:
        "outside" the workspace, a "stray", "in_front" of what was measured,
        "looked_through" or "known" (`prism_jax.completion.filtering`). One can be
        counted twice.
      left_out: how many measured points lie outside the workspace: strays, far from
        all others, unless the workspace was given. They are not among the points.
      inside: which of the given points are among them.
      capped: whether the density would need more than `filtering.MAX_DENSE` points.
      accepted: whether the adapted completion is the one returned
        (`prism_jax.adaptation.test_time.Completion` says what that means).
      losses: the terms of Eq. 13 before each step and after the last; without steps
        there are none.
      weights: of normals, denoising and alignment in them.
      workspace: the cube that was completed.
      camera: the view that depths were compared in.
      sensor: where it stands: "given", at the "origin", or "unknown".
      depth_observed, mask_observed: the measured points in that view.
      depth_completed, mask_completed: the completed ones.
      seconds: spent on compiling and on running.
      verdict: how far it can be trusted; None for weights without a calibration, or in
        fewer than three poses (`ModelConfig.poses`).
      sigma: how far each point is expected to lie from the true surface, on average
        (`prism_jax.uncertainty.sigma`): 0 for measured points, which are as the sensor
        gave them, its noise included. None for weights that cannot tell, or in fewer
        than three poses.
      known: what a library says of it (`prism_jax.registration`); None without one. If
        it is a model, that is what the measured points are completed with.
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
    verdict: Verdict | None = None
    sigma: Float[np.ndarray, " M"] | None = None
    inside: Bool[np.ndarray, " N"] | None = None
    capped: bool = False
    known: "Found | None" = None

    @property
    def label(self) -> UInt8[np.ndarray, " M"]:
        """Of each point as files have it: measured, predicted, or a known model's."""
        is_model = self.known is not None and self.known.model is not None
        return np.where(
            self.observed, OBSERVED, KNOWN if is_model else COMPLETED
        ).astype(np.uint8)


@dataclasses.dataclass(frozen=True)
class CompletedScene:
    """A scene with all its objects completed, in the user's frame and units.

    Attributes:
      points: the measured points, every one exactly as given and in the given order,
        and then what was added to each object.
      observed: True for a measured point.
      object: whose each point is: the objects' numbers from 0, the one of most measured
        points first; -1 on the support and on walls; -2 for what belongs to no object,
        outliers and what is too small.
      objects: each of them, completed by itself.
      planes: the support, if there is one, and then the walls.
      up: the direction that was taken to point upwards, of unit length.
      up_source: what says so: "given", or as `segmentation.support.Up` has it.
      sigma: as `CompletedScan` has it.
    """

    points: Float[np.ndarray, "M 3"]
    observed: Bool[np.ndarray, " M"]
    object: Int[np.ndarray, " M"]
    objects: tuple[CompletedScan, ...]
    planes: tuple[Plane, ...]
    up: Float[np.ndarray, "3"]
    up_source: str
    sigma: Float[np.ndarray, " M"] | None = None

    @property
    def label(self) -> UInt8[np.ndarray, " M"]:
        """As `CompletedScan` has it."""
        added = [one.label[~one.observed] for one in self.objects]
        measured = np.full(int(self.observed.sum()), OBSERVED, np.uint8)
        return np.concatenate([measured, *added])


class Task(NamedTuple):
    """One object to complete."""

    points: Float[np.ndarray, "N 3"]  # as the user gave them
    seen: Observation  # all of them in the unit workspace
    read: Observation  # those that the network reads
    view: Camera  # the view that it reads them in
    sensor: str  # where it stands: "given", at the "origin", or "unknown"
    # What the sensor knows of its view, if it was given what lies around.
    visibility: Visibility | None = None

    @property
    def eye(self) -> Float[np.ndarray, "3"] | None:
        """Where the sensor stands in the unit workspace, if anybody knows."""
        return None if self.sensor == "unknown" else np.asarray(self.seen.eye)


def assemble(
    task: Task,
    completion: Completion,
    options: CompletionOptions,
    seconds: dict[str, float],
    poses: int = 1,
    calibration: Calibration | None = None,
    point_errors: PointErrors | None = None,
) -> CompletedScan:
    """What a user gets of a completion in the unit workspace, of so many ``poses``.

    The verdict needs a ``calibration``, every point's sigma ``point_errors``, and both
    need three poses.
    """
    seen, read, view = task.seen, task.read, task.view
    # Filter and densify.
    joined = join(task, completion.points, options)
    prediction, selection = joined.prediction, joined.selection
    # Judge: the confidence of the whole, and the sigma of each point.
    looks = pose_predictions(completion.before, poses)
    verdict = None
    if looks is not None and calibration is not None:
        novelty = calibration.novelty(np.asarray(completion.features))
        outliers = float((selection.stray | selection.outside).mean())
        shares = outliers, float(selection.in_front.mean())
        evidence = evidence_of(seen, read, prediction, *shares, looks, novelty)
        half_extent = float(seen.workspace.half_extent)
        verdict = calibration.judge(evidence, half_extent)
        place = np.asarray(seen.workspace.from_unit(np.asarray(seen.eye)))
        if joined.closed:
            # Not high: a side can be missing all the same.
            error = 0.5 * half_extent * seen.cloud.spacing
            verdict = verdict._replace(
                trust="fair", expected_error=error, reasons=(CLOSED,)
            )
        stood, up = None if task.eye is None else place, seen.workspace.up
        if sees_scene(task.points[seen.inside], stood, up):
            verdict = verdict.doubted(SCENE)
        if rounded := rounding(task.points):
            verdict = verdict.doubted(rounded)
    sigma = None
    if looks is not None and point_errors is not None:
        kept = joined.kept
        clues = clues_of(kept.points, seen, read, prediction, looks)
        expected = spread(joined.new, kept, point_errors.sigma(clues))
        none = np.zeros(int(joined.observed.sum()))
        sigma = np.concatenate([none, expected * float(seen.workspace.half_extent)])
    # Assemble, in the user's frame and unit.
    terms = {} if completion.losses is None else completion.losses._asdict()
    wanted = options.density * seen.cloud.density * len(joined.kept)
    return CompletedScan(
        points=joined.points,
        observed=joined.observed,
        prediction=np.asarray(seen.workspace.from_unit(prediction.points)),
        left_out=len(task.points) - int(joined.observed.sum()),
        left_away={
            reason: int(which.sum())
            for reason, which in selection._asdict().items()
            if reason != "kept"
        },
        accepted=bool(completion.accepted),
        losses={
            name: np.asarray(values, np.float64).tolist()
            for name, values in terms.items()
        },
        weights=np.asarray(completion.weights),
        workspace=seen.workspace,
        camera=seen.camera_to_user(view),
        sensor=task.sensor,
        seconds=seconds,
        verdict=verdict,
        sigma=sigma,
        inside=np.asarray(seen.inside),
        capped=wanted > MAX_DENSE * joined.kept.density > 0,
        **_depth_maps(seen.cloud.points, joined.new, view, seen.workspace),
    )


def with_model(
    completed: CompletedScan, task: Task, options: CompletionOptions, found: "Found"
) -> CompletedScan:
    """The same with what a library says of it: if it is a model, its surface, where
    nothing was measured, stands in place of what the network predicted."""
    if found.match is None:
        return dataclasses.replace(completed, known=found)
    measured = completed.points[completed.observed]
    points, observed, sigma, dense = of_model(task, measured, options, found)
    error, told = float(sigma.mean()), found.match.evidence._asdict()
    return dataclasses.replace(
        completed,
        points=points,
        observed=observed,
        left_away=dict.fromkeys(completed.left_away, 0),
        verdict=Verdict("fair", error, (UNNOTICED,), told),
        sigma=sigma,
        capped=False,
        known=found,
        **_depth_maps(task.seen.cloud.points, dense, task.view, task.seen.workspace),
    )


def of_model(
    task: Task,
    measured: Float[np.ndarray, "N 3"],
    options: CompletionOptions,
    found: "Found",
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Float[np.ndarray, "A 3"]]:
    """The measured points and, of the surface of the model that was found, what lies
    where nothing was measured: the points, which are measured, the sigma of each, and
    those of the model alone in the unit workspace."""
    seen = task.seen
    points, sigma = found.placed()
    surface = IndexedCloud(seen.workspace.to_unit(points))
    dense = densify(surface, options.density * seen.cloud.density / surface.density)
    dense = dense[seen.cloud.distance(dense) > NEW * task.read.cloud.spacing]
    sigma = np.append(np.zeros(len(measured)), sigma[surface.tree.query(dense)[1]])
    added = seen.workspace.from_unit(dense).astype(measured.dtype)
    observed = np.arange(len(sigma)) < len(measured)
    return np.concatenate([measured, added]), observed, sigma, dense


class Joined(NamedTuple):
    """Measured and predicted points together."""

    # As `CompletedScan` has them, in the user's frame and unit.
    points: Float[np.ndarray, "M 3"]
    observed: Bool[np.ndarray, " M"]
    # The network's own output, in the unit workspace.
    prediction: IndexedCloud
    # What of it, and between it, is among the points, and what of it alone.
    new: Float[np.ndarray, "Q 3"]
    kept: IndexedCloud
    selection: Selection  # what became of each point of the prediction
    closed: bool  # nothing was added, as the measured points lie all around


def join(
    task: Task, predicted: Float[Array | np.ndarray, "P 3"], options: CompletionOptions
) -> Joined:
    """The measured points as they were, and behind them those of the network's
    ``predicted`` ones, in the unit workspace, that are new."""
    points, seen = task.points, task.seen
    measured, prediction = points[seen.inside], IndexedCloud(predicted)
    new, kept, selection = added_points(
        prediction,
        seen.cloud,
        task.read.cloud,
        task.eye,
        options.density,
        options.background,
        task.visibility,
    )
    closed = is_closed(seen.cloud.points, roughness(seen.cloud))
    if closed:
        new, kept = new[:0], IndexedCloud(kept.points[:0])
    added = seen.workspace.from_unit(new).astype(points.dtype)
    together = np.concatenate([measured, added])
    observed = np.arange(len(together)) < len(measured)
    return Joined(together, observed, prediction, new, kept, selection, closed)


def in_one_scene(
    points: Float[np.ndarray, "N 3"],
    number: Int[np.ndarray, " N"],
    objects: Sequence[CompletedScan],
    planes: Sequence[Plane],
    up: Float[np.ndarray, "3"],
    up_source: str,
) -> CompletedScene:
    """Objects put together again in their scene, of whose points each has a number."""
    added = [one.points[~one.observed] for one in objects]
    numbers = [np.full(len(cloud), i) for i, cloud in enumerate(added)]
    together = np.concatenate([points, *added])
    sigmas = [None if o.sigma is None else o.sigma[~o.observed] for o in objects]
    told = [sigma for sigma in sigmas if sigma is not None]
    sigma = np.concatenate([np.zeros(len(points)), *told])
    return CompletedScene(
        points=together,
        observed=np.arange(len(together)) < len(points),
        object=np.concatenate([number, *numbers]).astype(int),
        objects=tuple(objects),
        planes=tuple(planes),
        up=up,
        up_source=up_source,
        sigma=sigma if len(told) == len(objects) else None,
    )


def _depth_maps(
    measured: np.ndarray, added: np.ndarray, view: Camera, workspace: Workspace
) -> dict[str, Any]:
    """Depth of the measured and of all points, in the user's units."""
    view = view.resized(DEPTH_PIXELS, DEPTH_PIXELS)
    maps = {}
    clouds = {"observed": measured, "completed": np.concatenate([measured, added])}
    for name, cloud in clouds.items():
        depth, mask = _render(padded(cloud).astype(np.float32), view)
        maps[f"depth_{name}"] = np.asarray(depth) * workspace.half_extent
        maps[f"mask_{name}"] = np.asarray(mask)
    return maps
