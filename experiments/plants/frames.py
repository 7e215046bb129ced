"""Frames without ground truth, what is asked of the network about them, and batches."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from tqdm import tqdm

from experiments.plants.occlusion import occluded
from prism_jax.adaptation.config import PrismConfig
from prism_jax.data.holdout import Subset
from prism_jax.data.ordering import farthest_point_order
from prism_jax.data.pipeline import Batch, Framing, frame_example
from prism_jax.data.source import Example, Source
from prism_jax.evaluation.protocol import Protocol, observed
from prism_jax.io.errors import InputError
from prism_jax.observation.observation import Observation
from prism_jax.observation.strays import find_strays
from prism_jax.selection import select

MAX_MEASURED = 8192
"""Measured points that are kept of a frame: evenly spaced rows of a larger cloud."""

FEW = 5
"""One sequence in so many checks, or one frame in so many where sequences are fewer."""


class Unlabelled:
    """A source whose ground truth nobody sees: it is dropped as an example is read."""

    def __init__(self, source: Source):
        self._source = source
        self.categories, self.objects = source.categories, source.objects

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> Example:
        return self._source[index]._replace(complete=None)


class Frame(NamedTuple):
    """One frame of a recording.

    Attributes:
      name: unique within the recordings.
      object: the number of its sequence.
      measured: what was measured, in its own frame and unit.
      eye: where the sensor stood; None if nobody knows.
      any_heading: as an `Example` has it.
      seen: what the network reads of the whole of it.
    """

    name: str
    object: int
    measured: Float[np.ndarray, "N 3"]
    eye: Float[np.ndarray, "3"] | None
    any_heading: bool
    seen: Observation


def evenly(source: Source, count: int | None) -> Source:
    """So many examples of a source, evenly spaced; all of them for None."""
    if count is None or count >= len(source):
        return source
    return Subset(source, np.unique(np.linspace(0, len(source) - 1, count, dtype=int)))


def read_frames(source: Source, config: PrismConfig) -> list[Frame]:
    """All frames of a source, as the network reads them, without strays.

    A frame without measured points raises InputError.
    """
    protocol = reading(config)
    frames = []
    rows = tqdm(range(len(source)), "frames", unit="frame", mininterval=2.0)
    for row, number in zip(rows, source.objects, strict=True):
        example = source[row]
        if example.partial is None:
            remedy = "use a set with partial clouds of its own"
            raise InputError(example.name, "has no measured points", remedy)
        points = example.partial[~find_strays(example.partial)]
        points = points[:: -(-len(points) // MAX_MEASURED)]
        eye = example.eye
        if eye is not None and not np.isfinite(eye).all():
            eye = None
        example = example._replace(partial=points, ordered=False, eye=eye)
        frames.append(
            Frame(
                example.name,
                int(number),
                points.astype(np.float64),
                None if eye is None else eye.astype(np.float64),
                example.any_heading,
                observed(example, protocol),
            )
        )
    return frames


def reading(config: PrismConfig) -> Protocol:
    """How the network reads a frame: as every completion does."""
    model = config.model
    return Protocol(model.backbone.num_points, model.margin, heading=model.heading)


def held_out(
    objects: Int[np.ndarray, " F"],
) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " C"]]:
    """Rows of the frames to train on, and of those that check.

    Every fifth sequence checks with all its frames; where there are fewer than five,
    every fifth frame does. Fewer than five frames raise InputError.
    """
    if len(objects) < FEW:
        fault = f"{len(objects)} frames are too few to hold some out"
        raise InputError("recordings", fault, f"record {FEW} or more")
    several = len(np.unique(objects)) >= FEW
    numbers = np.unique(objects, return_inverse=True)[1]
    checks = (numbers if several else np.arange(len(objects))) % FEW == FEW // 2
    return np.flatnonzero(~checks), np.flatnonzero(checks)


def other_sequences(
    source: Source, categories: Sequence[str]
) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " S"]]:
    """Rows of a source by sequence: to adapt to, and to be scored on.

    `categories` are of the source's items. Of each category every other sequence is
    scored, and the rest, with the first, is adapted to: the two have the same robots
    and no sequence in common. Categories of a single sequence are adapted to alone.
    """
    objects, names = source.objects, np.asarray(categories)
    scored = np.zeros(len(objects), bool)
    for name in np.unique(names):
        numbers = np.unique(objects[names == name])
        scored |= (names == name) & np.isin(objects, numbers[1::2])
    return np.flatnonzero(~scored), np.flatnonzero(scored)


def pseudo_label(
    frame: Frame, prediction: Float[np.ndarray, "P 3"], count: int, reach: float
) -> Float[np.ndarray, "M 3"]:
    """What was measured and what the teacher adds to it consistently.

    `prediction` is the teacher's, in the unit of `frame.seen`. Kept of it is what a
    user would get (`prism_jax.selection.select`), but nothing farther than `reach` half
    sides from all that was measured: a teacher learns to reach beyond what it sees,
    and a student that it taught so would reach farther still. `count` points in
    farthest-point order, in the frame's own frame and unit.
    """
    seen = frame.seen
    prediction = np.asarray(prediction, np.float64)
    measured = np.asarray(seen.workspace.to_unit(frame.measured))
    selection = select(
        prediction,
        measured,
        np.asarray(seen.partial),
        None if frame.eye is None else np.asarray(seen.eye),
    )
    near = KDTree(measured).query(prediction)[0] <= reach
    added = np.asarray(seen.workspace.from_unit(prediction[selection.kept & near]))
    return farthest_point_order(np.concatenate([frame.measured, added]), count)


def student_view(
    frame: Frame,
    label: Float[np.ndarray, "M 3"],
    num_hidden: int,
    whole: float,
    framing: Framing,
    rng: np.random.Generator,
) -> Batch:
    """What the student reads of a frame, and what it is to return.

    A new virtual occlusion, or with the probability `whole` the frame as it is, framed,
    turned and mirrored as in every training (`prism_jax.data.pipeline.frame_example`).
    ``complete`` is the label, and behind it `num_hidden` points of what was hidden, or
    of all that was measured where nothing was.
    """
    kept, hidden, eye = frame.measured, frame.measured, frame.eye
    if rng.random() >= whole:
        kept, hidden, eye = occluded(frame.measured, frame.eye, rng)
    wanted = np.concatenate([label, farthest_point_order(hidden, num_hidden)])
    example = Example(
        wanted.astype(np.float32),
        farthest_point_order(kept, framing.num_partial).astype(np.float32),
        None if eye is None else eye.astype(np.float32),
        "",
        frame.name,
        ordered=True,
        any_heading=frame.any_heading,
    )
    return frame_example(example, framing, rng)
