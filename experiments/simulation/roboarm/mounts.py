"""What an arm stands on: a table, a pedestal, the floor, or a linear axis.

World frame: metres, z up, floor at z = 0. The arm's first place is above the origin.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from manifold3d import Manifold

from experiments.simulation.roboarm.furnishings import pedestal, table
from experiments.simulation.solids import Rng, box, rod

MOUNTS = ("table", "pedestal", "plinth", "floor", "rail")
SHARES = {
    "small": (0.45, 0.3, 0.05, 0.0, 0.2),
    "medium": (0.15, 0.3, 0.15, 0.15, 0.25),
    "large": (0.0, 0.1, 0.25, 0.35, 0.3),
}
"""How often arms of each size stand on what."""
SMALL, LARGE = 0.8, 1.7
"""Metres of reach below which an arm is small, and from which on it is large."""


class Mount(NamedTuple):
    """What an arm stands on."""

    kind: str  # one of `MOUNTS`
    bases: Float64[np.ndarray, "T 3"]  # the arm's foot by frame: a linear axis moves it
    support: Sequence[Manifold] = ()  # tables, pedestals, plates
    track: Sequence[Manifold] = ()  # what of a linear axis stands still, a fixture
    # What of it moves with the arm, in the frame of the foot, a fixture.
    carriage: Sequence[Manifold] = ()
    # Corners (x, y) and height of a table top that fixtures may stand on.
    top: tuple[np.ndarray, np.ndarray, float] | None = None


def random_mount(
    reach: float,
    foot: Float64[np.ndarray, "2 2"],
    spacer: float,
    num_frames: int,
    rng: Rng,
) -> Mount:
    """A mount for an arm of this reach.

    `foot` is the lower and the upper corner (x, y) of its first link; a `spacer` below
    it becomes a post.
    """
    size = "small" if reach < SMALL else "medium" if reach < LARGE else "large"
    kind, half = str(rng.choice(MOUNTS, p=SHARES[size])), float(np.abs(foot).max())
    half = max(min(half, 0.35 * reach), 0.06)
    if kind == "rail":
        mount = _rail(reach, half, num_frames, rng)
    elif kind == "table":
        height = rng.uniform(0.6, 0.95)
        across = np.maximum(reach * rng.uniform(0.4, 0.65, 2), half + 0.15)
        shift = rng.uniform(-1, 1, 2) * np.maximum(across - half - 0.08, 0)
        top = shift - across, shift + across, height
        mount = Mount(kind, _still(height, num_frames), table(*top), top=top)
    elif kind == "pedestal":
        height = rng.uniform(0.3, 0.9) if size != "large" else rng.uniform(0.3, 0.6)
        mount = Mount(kind, _still(height, num_frames), pedestal(height, half))
    else:
        low = kind == "floor"
        height = rng.uniform(0.01, 0.04) if low else rng.uniform(0.1, 0.5)
        side = 2 * half * rng.uniform(1.1, 1.5, 2)
        block = box((0, 0, height / 2), (*side, height), 0.0 if low else 0.01)
        mount = Mount(kind, _still(height, num_frames), [block])
    if spacer:
        # It stands on the carriage of an axis, and moves with it.
        post = rod((0, 0, 0), (0, 0, spacer), 0.06)
        if kind == "rail":
            return mount._replace(carriage=[*mount.carriage, post])
        raised = post.translate(tuple(map(float, mount.bases[0])))  # pyright: ignore
        return mount._replace(support=[*mount.support, raised])
    return mount


def _still(height: float, num_frames: int) -> np.ndarray:
    return np.tile([0.0, 0.0, height], (num_frames, 1))


def _rail(reach: float, half: float, num_frames: int, rng: Rng) -> Mount:
    """A linear axis along x or y with the arm at some places on it."""
    length = reach * rng.uniform(0.7, 1.7) + 3 * half
    width, height = 2.2 * half, reach * rng.uniform(0.08, 0.2)
    plate, room = 0.04 + 0.05 * half, length / 2 - 1.3 * half
    places = rng.uniform(-room, room, num_frames)
    gauge, rail = 0.38 * width, 0.05 * width
    middle = -places[0]
    track = [
        box((middle, side * gauge, 0.45 * height), (length, 0.16 * width, 0.9 * height))
        for side in (-1, 1)
    ]
    track += [
        box((middle, side * gauge, 0.95 * height), (length, rail, 0.1 * height))
        for side in (-1, 1)
    ]
    for x in np.linspace(-0.45, 0.45, int(rng.integers(3, 7))) * length + middle:
        track.append(box((x, 0, 0.3 * height), (0.1 * width, width, 0.3 * height)))
    if rng.random() < 0.6:  # the trough of the cables
        at = (middle, 0.62 * width, 0.25 * height)
        track.append(box(at, (0.9 * length, 0.16 * width, 0.5 * height)))
    carriage = [box((0, 0, -plate / 2), (2.4 * half, width, plate), 0.004)]
    for x, side in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        shoe = (0.9 * x * half, side * gauge, -plate - 0.03 * height)
        carriage.append(box(shoe, (0.4 * half, 3 * rail, 0.1 * height)))
    bases = np.stack(
        [places - places[0], 0 * places, np.full(num_frames, height + plate)], axis=1
    )
    if rng.random() < 0.5:
        turn = (0.0, 0.0, 90.0)
        track = [solid.rotate(turn) for solid in track]
        carriage = [solid.rotate(turn) for solid in carriage]
        bases = bases[:, [1, 0, 2]]
    return Mount("rail", bases, (), track, carriage)
