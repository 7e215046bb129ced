"""Examples of any source as batches of arrays, shuffled and resumable, by Grain."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from absl import flags
from jaxtyping import Float32
from scipy.spatial.transform import Rotation

from prism_jax.data.crops import CROP_SHARES, CROP_VIEWPOINTS, crop, random_crop
from prism_jax.data.ordering import first_points
from prism_jax.data.source import Example, Source
from prism_jax.geometry.visibility import Visibility, mirrored, turned
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError, require
from prism_jax.preprocessing.observation import Heading, observe, workspace_around
from prism_jax.preprocessing.outliers import far_outliers
from prism_jax.preprocessing.visibility_map import seen_among

MAX_TILT = np.deg2rad(20.0)
"""Of training examples whose heading the network finds itself."""

ASIDE = 4  # one in so many of those gets a random quarter turn


class Batch(NamedTuple):
    """Clouds in the unit workspace that each partial determines."""

    partial: Float32[np.ndarray, "*B N 3"]  # measured points, in farthest-point order
    # The whole surface, in farthest-point order.
    complete: Float32[np.ndarray, "*B M 3"]
    eye: Float32[np.ndarray, "*B 3"]  # where the sensor stood
    # What turns a distance here into one in the unit of the scores, half the longest
    # side of the complete cloud.
    scale: Float32[np.ndarray, "*B"]
    visibility: Visibility | None = None  # what each sensor knows, if the source says


class Framing(NamedTuple):
    """How examples become arrays of one size: points of the partial and of the
    complete cloud, the workspace's margin around the partial, and its heading."""

    num_partial: int
    num_complete: int
    margin: float
    heading: Heading = "given"


def frame_example(
    example: Example, framing: Framing, rng: np.random.Generator | None = None
) -> Batch:
    """One example in the workspace of its partial, without a batch axis.

    With `rng`, for training: mirrored along x with probability one half; turned about
    the vertical at random where it may have any heading; and a partial that is None is
    cropped at random. Without, it is cropped as the median test from the first fixed
    viewpoint.

    Where the network finds the heading itself, each example has any heading, and every
    other a tilt of up to `MAX_TILT`; without `rng` these are a function of the
    example's name. For training, one in `ASIDE` then gets a random quarter turn.
    """
    example = with_partial(example, rng)
    assert example.partial is not None and example.complete is not None
    partial, eye, visibility = example.partial, example.eye, example.visibility
    # Before they are turned, so that the order is the same in every heading.
    few = first_points(partial, framing.num_partial, example.ordered)
    many = first_points(example.complete, framing.num_complete, example.ordered)
    unit = Workspace.from_points(example.complete, 1.0)
    if visibility is not None and not visibility.state.any():
        visibility = None  # of a packed view of which none was kept
    pose = _pose(example, framing, rng)
    if pose is not None:
        partial, few, many = partial @ pose, few @ pose, many @ pose
        eye = None if eye is None else eye @ pose
        visibility = None if visibility is None else turned(visibility, pose)
    workspace = workspace_around(partial, eye, framing.margin, heading=framing.heading)
    seen = observe(few, eye, workspace)
    batch = Batch(
        np.asarray(seen.partial, np.float32),
        np.asarray(workspace.to_unit(many), np.float32),
        np.asarray(seen.eye, np.float32),
        np.asarray(workspace.half_extent / unit.half_extent, np.float32),
        visibility=framed_map(visibility, workspace),
    )
    if rng is None:
        return batch
    if framing.heading == "level" and rng.random() < 1 / ASIDE:
        turn = np.rint(_about_vertical(int(rng.integers(4)) * 0.5 * np.pi))
        batch = _moved(batch, lambda cloud: cloud @ turn, lambda m: turned(m, turn))
    if rng.random() < 0.5:
        return batch
    sign = np.array([-1, 1, 1], np.float32)
    return _moved(batch, lambda cloud: cloud * sign, mirrored)


def with_partial(example: Example, rng: np.random.Generator | None = None) -> Example:
    """The example with a partial, cropped as `frame_example` has it if it had none.
    Without strays (`prism_jax.preprocessing.outliers`), which would decide the
    workspace. An example without a complete cloud raises InputError."""
    if example.complete is None:
        fault = "no complete cloud for training or scoring"
        raise InputError(example.name, fault, "use it for completion only")
    if example.partial is not None:
        sound = ~far_outliers(example.partial)
        return example._replace(partial=example.partial[sound])
    if rng is None:
        partial = crop(example.complete, CROP_VIEWPOINTS[0], CROP_SHARES["median"])
    else:
        partial = random_crop(example.complete, rng)[0]
    return example._replace(partial=partial, ordered=False)


def training_batches(
    source: Source,
    framing: Framing,
    batch_size: int,
    seed: int,
    num_workers: int = 0,
    start: int = 0,
) -> Iterator[Batch]:
    """Endless batches: each example once per epoch, freshly shuffled and mirrored.

    What the n-th batch holds is a function of the source, the framing, the size, the
    seed and n alone; `start` is the n of the first. `num_workers` processes read ahead,
    0 for threads of this one.
    """
    grain = require("grain", "train")
    if len(source) < batch_size:
        fault = f"{len(source)} examples do not fill a batch of {batch_size}"
        raise InputError("data", fault, "add data, or set a smaller batch_size (--set)")
    dataset = (
        grain.MapDataset.source(source)
        .seed(seed)
        .shuffle()
        .repeat()
        .random_map(lambda example, rng: frame_example(example, framing, rng))
        .batch(batch_size, batch_fn=stack)
        .slice(slice(start, None))
    )
    reading = grain.ReadOptions(num_threads=1, prefetch_buffer_size=4)
    batches = dataset.to_iter_dataset(reading)
    if num_workers == 0:
        return iter(batches)
    if not flags.FLAGS.is_parsed():
        # Grain's processes read absl's flags; not every caller is an absl program.
        flags.FLAGS.mark_as_parsed()
    workers = grain.MultiprocessingOptions(num_workers, per_worker_buffer_size=2)
    return iter(batches.mp_prefetch(workers))


def stack(rows: Sequence[Batch]) -> Batch:
    """Examples side by side along a new first axis. Where some have maps, others get
    what their clouds say, with nothing around them."""
    if any(row.visibility is not None for row in rows):
        rows = [_with_map(row) for row in rows]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _with_map(row: Batch) -> Batch:
    if row.visibility is not None:
        return row
    nothing, cube = row.partial[:0], Workspace.unit()
    visibility = seen_among(row.partial, nothing, row.eye, cube, "empty")
    return row._replace(visibility=framed_map(visibility, cube))


def _pose(
    example: Example, framing: Framing, rng: np.random.Generator | None
) -> Float32[np.ndarray, "3 3"] | None:
    """What turns an example's points, as rows, before it is framed, if anything does.
    Framing takes no notice of where the axes are."""
    if framing.heading == "given":
        if rng is None or not example.any_heading:
            return None
        return _about_vertical(rng.uniform(0.0, 2.0 * np.pi))
    if rng is None:
        digest = hashlib.sha256(example.name.encode()).digest()
        rng = np.random.default_rng(int.from_bytes(digest[:8]))
    turn = _about_vertical(rng.uniform(0.0, 2.0 * np.pi))
    if rng.random() < 0.5:
        return turn
    axis = _about_vertical(rng.uniform(0.0, 2.0 * np.pi))[0]
    tilt = Rotation.from_rotvec(rng.uniform(0.0, MAX_TILT) * axis)
    return turn @ tilt.as_matrix().astype(np.float32)


def _about_vertical(angle: float) -> Float32[np.ndarray, "3 3"]:
    """Turns points, as rows, about z."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([(cosine, sine, 0), (-sine, cosine, 0), (0, 0, 1)], np.float32)


def framed_map(
    visibility: Visibility | None, workspace: Workspace
) -> Visibility | None:
    """In the unit of the workspace, and in single precision; None where the source does
    not say."""
    if visibility is None:
        return None
    camera = workspace.camera_to_unit(visibility.camera)
    camera = jax.tree.map(lambda array: np.asarray(array, np.float32), camera)
    depth = np.asarray(visibility.depth / workspace.half_extent, np.float32)
    return Visibility(camera, visibility.state, depth)


def _moved(batch: Batch, move: Callable, move_map: Callable) -> Batch:
    """Turned or mirrored about the middle of the unit workspace."""
    visibility = None if batch.visibility is None else move_map(batch.visibility)
    clouds = "partial", "complete", "eye"
    moved = {name: move(getattr(batch, name)) for name in clouds}
    return batch._replace(**moved, visibility=visibility)
