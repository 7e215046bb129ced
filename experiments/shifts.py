"""What real scans differ by from the views that networks are trained on.

A shift changes a partial view, its sensor and the frame of both; the truth follows.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from prism_jax.data.datasets import open_dataset, validation_split
from prism_jax.data.pipeline import with_partial
from prism_jax.selection import densify

HEADINGS = tuple(range(0, 360, 45))
TILT = 36.0
DENSITIES = (100, 500, 2_000, 20_000, 200_000)
NOISES = (0.005, 0.01, 0.02)
CROPS = (0.1, 0.3, 0.5)

TABLE_SIDE = 3.0
"""Of the table under a tilted object, in the object's longest side."""


@dataclasses.dataclass(frozen=True)
class View:
    """A partial cloud, where its sensor stood, and the truth, all in one frame.

    `table` are points of what the object stands on, where that is in the view. `size`
    is the longest side of the truth's box before any turn, `group` the number of the
    object that is shown.
    """

    partial: Float[np.ndarray, "N 3"]
    complete: Float[np.ndarray, "M 3"]
    eye: Float[np.ndarray, "3"] | None
    size: float
    table: Float[np.ndarray, "T 3"] | None = None
    group: int = 0


def validation_views(
    dataset: str,
    limit: int | None = None,
    split: str | None = None,
    data_dir: str | None = None,
) -> list[View]:
    """Those of a data set's validation split, unless another is named, or so many of
    them, evenly spaced."""
    source = open_dataset(dataset, split or validation_split(dataset), data_dir)
    count = min(len(source), limit or len(source))
    views = []
    for row in np.linspace(0, len(source) - 1, count).astype(int):
        example = with_partial(source[int(row)])
        clouds = (example.partial, example.complete, example.eye)
        double = [None if c is None else c.astype(np.float64) for c in clouds]
        assert example.complete is not None
        size = float(np.ptp(example.complete, axis=0).max())
        group = int(source.objects[row])
        views.append(View(*double, size, group=group))  # pyright: ignore
    return views


Shift = Callable[[View, np.random.Generator], View]


def turned(view: View, rotation: Rotation) -> View:
    """All of it about the origin."""
    matrix = rotation.as_matrix()

    def turn(cloud: np.ndarray | None) -> np.ndarray | None:
        return None if cloud is None else cloud @ matrix.T

    clouds = {
        name: turn(getattr(view, name))
        for name in ("partial", "complete", "eye", "table")
    }
    return dataclasses.replace(view, **clouds)


def heading(degrees: float) -> Shift:
    """Turned about the vertical."""
    return lambda view, rng: turned(view, Rotation.from_euler("z", degrees, True))


def tilted(view: View, rng: np.random.Generator) -> View:
    """By `TILT` about a random horizontal axis, at a random heading, on a table.

    The table is as dense as the object, noisy by a thousandth of its size, and without
    what the object covers.
    """
    lower, upper = view.complete.min(axis=0), view.complete.max(axis=0)
    count = int(len(view.partial) * TABLE_SIDE**2 / 3)
    table = np.empty((count, 3))
    middle = 0.5 * (lower + upper)[:2]
    table[:, :2] = middle + rng.uniform(-0.5, 0.5, (count, 2)) * TABLE_SIDE * view.size
    table[:, 2] = lower[2] + rng.normal(0.0, 1e-3 * view.size, count)
    under = ((table > lower) & (table < upper))[:, :2].all(axis=1)
    angle = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    turn = Rotation.from_rotvec(np.deg2rad(TILT) * axis)
    turn = turn * Rotation.from_euler("z", rng.uniform(0, 360), True)
    return turned(dataclasses.replace(view, table=table[~under]), turn)


def with_points(count: int) -> Shift:
    """Thinned at random, or made denser between its points."""

    def shift(view: View, rng: np.random.Generator) -> View:
        partial = view.partial
        if count > len(partial):
            partial = densify(partial, count / len(partial))
        else:
            partial = partial[rng.permutation(len(partial))[:count]]
        return dataclasses.replace(view, partial=partial)

    return shift


def noisy(share: float) -> Shift:
    """Gaussian in each coordinate, of a share of the object's longest side."""

    def shift(view: View, rng: np.random.Generator) -> View:
        noise = rng.normal(0.0, share * view.size, view.partial.shape)
        return dataclasses.replace(view, partial=view.partial + noise)

    return shift


def cropped(share: float) -> Shift:
    """Without that share of the points that lies farthest in some direction."""

    def shift(view: View, rng: np.random.Generator) -> View:
        direction = rng.normal(size=3)
        along = view.partial @ direction
        kept = along <= np.quantile(along, 1.0 - share)
        return dataclasses.replace(view, partial=view.partial[kept])

    return shift


def any_shift(view: View, rng: np.random.Generator) -> tuple[str, View]:
    """One of every kind, of random strength, at a random heading; and what it is."""
    kind = str(rng.choice(["heading", "tilt", "points", "noise", "crop"]))
    shifted = turned(view, Rotation.from_euler("z", rng.uniform(0, 360), True))
    if kind == "tilt":
        shifted = tilted(shifted, rng)
    elif kind == "points":
        count = int(np.exp(rng.uniform(np.log(100), np.log(20_000))))
        shifted = with_points(count)(shifted, rng)
    elif kind == "noise":
        shifted = noisy(rng.uniform(0.0, 0.03))(shifted, rng)
    elif kind == "crop":
        shifted = cropped(rng.uniform(0.05, 0.6))(shifted, rng)
    return kind, shifted


SHIFTS: dict[str, Shift] = {
    **{f"heading {degrees}": heading(degrees) for degrees in HEADINGS},
    f"tilt {TILT:g}, on a table": tilted,
    **{f"{count:,} points": with_points(count) for count in DENSITIES},
    **{f"noise {100 * share:g} %": noisy(share) for share in NOISES},
    **{f"cropped by {100 * share:g} %": cropped(share) for share in CROPS},
}
"""By the names that tables give them."""
