"""Frames without ground truth: what is hidden of them, and what a student is taught."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from experiments.protocol import Protocol, observed
from experiments.simulation.raycast import Scene
from experiments.simulation.surroundings import random_occluder
from experiments.simulation.truncation import random_cut
from prism_jax.completion.filtering import select
from prism_jax.data.crops import random_crop
from prism_jax.data.ordering import farthest_point_order
from prism_jax.data.pipeline import Batch, Framing, frame_example
from prism_jax.data.source import Example, Source
from prism_jax.geometry.cloud import IndexedCloud, sight
from prism_jax.io.errors import InputError
from prism_jax.models.config import ModelConfig
from prism_jax.preprocessing.observation import Observation
from prism_jax.preprocessing.outliers import far_outliers
from prism_jax.preprocessing.visibility import IN_FRONT, NUM_RAYS, SIGHT_REACH

MAX_MEASURED = 8192  # points that are kept of a frame: evenly spaced rows of it
HIDDEN_SHARES = (0.1, 0.75)  # of the points: the least and the most that are hidden
FEWEST = 32  # points that are left at least, where there are as many to begin with
TURNS = (20.0, 100.0)  # degrees about the vertical between a sensor and a second one

Cloud = Float[np.ndarray, "_ 3"]


@dataclasses.dataclass(frozen=True)
class PlantConfig:
    """How a network is trained on frames without truth."""

    batch_size: int = 8
    num_label: int = 2048  # points of a pseudo-label that the loss looks at
    num_hidden: int = 512  # and of what was hidden
    reach: float = 0.15  # of labels, from what was measured, in half sides
    whole: float = 0.25  # share of frames that the student reads without occlusion
    hidden_weight: float = 0.25  # of the way from what was hidden to the prediction
    auxiliary_weight: float = 0.01  # of the objective of Eq. 13


class PlantFrame(NamedTuple):
    """One frame of a recording."""

    example: Example  # without strays and without truth
    object: int  # the number of its sequence
    seen: Observation  # what the network reads of all of it


def read_frame(source: Source, row: int, model: ModelConfig) -> PlantFrame:
    """A row of a source, whose truth is dropped before anything can look at it. One
    without measured points raises InputError."""
    example = source[row]._replace(complete=None, ordered=False, visibility=None)
    if example.partial is None:
        remedy = "use a set with partial clouds of its own"
        raise InputError(example.name, "has no measured points", remedy)
    points, eye = example.partial[~far_outliers(example.partial)], example.eye
    points = points[:: -(-len(points) // MAX_MEASURED)]
    eye = None if eye is None or not np.isfinite(eye).all() else eye
    example = example._replace(partial=points, eye=eye)
    seen = observed(example, reading(model))
    return PlantFrame(example, int(source.objects[row]), seen)


def reading(model: ModelConfig) -> Protocol:
    """How the network reads a frame: as every completion does."""
    return Protocol(model.backbone.num_points, model.margin, heading=model.heading)


def pseudo_label(frame: PlantFrame, prediction: Cloud, settings: PlantConfig) -> Cloud:
    """What was measured and, of the teacher's prediction in the unit of `frame.seen`,
    what a user would get, but nothing farther than ``reach`` from what was measured: a
    student that learned to reach farther than it sees would then teach that."""
    points: Any = frame.example.partial
    workspace = frame.seen.workspace
    measured = np.asarray(workspace.to_unit(points))
    eye = None if frame.example.eye is None else np.asarray(frame.seen.eye)
    kept = select(prediction, measured, np.asarray(frame.seen.partial), eye).kept
    kept &= KDTree(measured).query(prediction)[0] <= settings.reach
    added = np.asarray(workspace.from_unit(prediction[kept]), np.float32)
    return farthest_point_order(np.concatenate([points, added]), settings.num_label)


def student_view(
    example: Example, label: Cloud, settings: PlantConfig, framing: Framing, rng: Any
) -> Batch:
    """What the student reads of a frame, framed as in every training: what an occlusion
    leaves, or sometimes the whole. ``complete`` is the label, and behind it what was
    hidden, or some of all where nothing was."""
    kept: Any = example.partial
    hidden, eye = kept, example.eye
    if rng.random() >= settings.whole:
        kept, hidden, eye = occluded(example, rng)
    kept = farthest_point_order(kept, framing.num_partial)
    wanted = np.concatenate([label, farthest_point_order(hidden, settings.num_hidden)])
    view = example._replace(complete=wanted, partial=kept, eye=eye, ordered=True)
    return frame_example(view, framing, rng)


def hide(example: Example, look: int, model: ModelConfig) -> tuple[Cloud, Observation]:
    """What an occlusion hides, the same for every network, and what is read then."""
    rng = np.random.default_rng((look, *example.name.encode()))
    kept, hidden, eye = occluded(example, rng)
    return hidden, observed(example._replace(partial=kept, eye=eye), reading(model))


def occluded(example: Example, rng: Any) -> tuple[Cloud, Cloud, np.ndarray | None]:
    """What is kept of the measured points, what is hidden, and the sensor's new place.

    Something stands between, or the image's edge, a half space or a box cuts the points
    off, or a second sensor looks from another side. Where none of these hides a share
    of `HIDDEN_SHARES`, and where nobody knows where the sensor stood, what is nearest
    to a random viewpoint goes. Fewer than four points raise ValueError.
    """
    cloud: Any = example.partial
    eye = example.eye
    if len(cloud) < 4:
        raise ValueError("too few points to hide some")
    ways = (_behind_something, _within_a_cut, _seen_from_elsewhere)
    for way in rng.permutation(len(ways)) if eye is not None else ():
        kept, place = ways[way](cloud.astype(float), np.asarray(eye, float), rng)
        share = 1.0 - kept.mean()
        enough = kept.sum() >= min(FEWEST, len(cloud) // 2)
        if HIDDEN_SHARES[0] <= share <= HIDDEN_SHARES[1] and enough:
            return cloud[kept], cloud[~kept], place.astype(np.float32)
    rest, _ = random_crop(cloud, rng)
    gone = KDTree(rest).query(cloud)[0] > 0
    return cloud[~gone], cloud[gone], eye


def _behind_something(points, eye, rng):
    thing = random_occluder(eye, points, rng)
    kept = np.ones(len(points), bool)
    if thing is not None:
        hits = thing.cast(eye, points - eye)
        away = np.linalg.norm(points - eye, axis=1)[hits.ray]
        kept[hits.ray[hits.distances < away]] = False
    return kept, eye


def _within_a_cut(points, eye, rng):
    box = trimesh.creation.box(bounds=[points.min(axis=0), points.max(axis=0)])
    return random_cut(Scene(box), eye, points, rng).holds(points), eye


def _seen_from_elsewhere(points, eye, rng):
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    angle = rng.choice([-1.0, 1.0]) * rng.uniform(*TURNS)
    turn = Rotation.from_euler("z", angle, degrees=True)
    other = middle + turn.apply(eye - middle)
    return seen_from(points, other), other


def seen_from(points: Cloud, eye: Float[np.ndarray, "3"]) -> Bool[np.ndarray, " N"]:
    """Which points no other one hides: none about their line of sight is nearer to the
    eye by more than `IN_FRONT` spacings."""
    (directions, distance), spacing = sight(points, eye), IndexedCloud(points).spacing
    reach = SIGHT_REACH * spacing / np.median(distance)
    tree = KDTree(directions)
    _, rows = tree.query(directions, k=NUM_RAYS, distance_upper_bound=reach)
    nearest = np.append(distance, np.inf)[rows].min(axis=1)
    return distance - nearest <= IN_FRONT * spacing
