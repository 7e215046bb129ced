"""A scene taken apart: what things stand on, the objects, and what is left over."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int

from prism_jax.geometry.camera import Vector
from prism_jax.preprocessing.segmentation.background import bounding
from prism_jax.preprocessing.segmentation.clusters import extent
from prism_jax.preprocessing.segmentation.parts import objects_of
from prism_jax.preprocessing.segmentation.planes import (
    COARSE,
    Outline,
    Plane,
    Thinned,
    outline,
)
from prism_jax.preprocessing.segmentation.support import (
    FILLED,
    LINK_SPACINGS,
    Up,
    find_support,
    find_up,
    given_up,
)
from prism_jax.preprocessing.upright import AUTO

SUPPORT, LEFT_OVER = -1, -2  # in `SegmentedScene.object`; objects count from 0
SHEET = 0.95  # a plane with this share of a cloud is all there is
# So far apart the parts of one object can be, in the longest side of a cloud without
# any plane, where it hides its own surface.
GAP = 0.25
EDGE = 0.05  # a wall rises no farther inside a support's border, in the support's width
MIN_POINTS = 64  # of an object: fewer cannot be completed
MIN_SIZE = 0.02  # of an object, in the longest side of the scene


@dataclasses.dataclass(frozen=True)
class SegmentedScene:
    """Whose points are whose."""

    # For each point the number of its object, from 0, the one of most points first;
    # `SUPPORT` on the planes set aside, `LEFT_OVER` for outliers and what is too small
    # to be completed.
    object: Int[np.ndarray, " N"]
    planes: tuple[Plane, ...]  # those set aside, the support first, if there is one
    num_points: tuple[int, ...]  # of each object
    num_support: int  # how many points lie on the planes
    num_left_over: int  # how many belong to nothing
    up: Up = dataclasses.field(default_factory=lambda: given_up("z"))


def split_scene(
    points: Float[np.ndarray, "N 3"],
    up: str | Vector = "z",
    sensor: Vector | None = None,
    camera_rotation: Float[Array | np.ndarray, "3 3"] | None = None,
) -> SegmentedScene:
    """Planes set aside, and the rest as objects (`objects_of`).

    `up` is as `upright` has it, or "auto" (`find_up`), `sensor` the place the points
    were seen from, or None. Set aside are the support (`find_support`) and with it
    other planes that are at least as long as it is wide and do not rise from its midst:
    walls, another floor; and all that the view of a known sensor ends at (`bounding`).
    A cloud that is one plane is all support. A cloud with nothing to set aside is one
    object, unless its parts are over `GAP` apart.

    The same points give the same scene; unit and origin do not matter. Points must be
    finite. An `up` that is no direction raises InputError.
    """
    thinned = Thinned(points)
    points = thinned.points
    if isinstance(up, str) and up == AUTO:
        found = find_up(thinned, sensor, camera_rotation)
    else:
        found = given_up(up)
    eye = None if sensor is None else np.asarray(sensor, np.float64)
    if eye is not None and not np.isfinite(eye).all():
        eye = None
    size = extent(thinned.cells.points)
    support, walls, aside = _set_aside(thinned, eye, camera_rotation)
    number = np.where(aside, SUPPORT, LEFT_OVER)
    planes = walls if support is None else [support, *walls]
    if not aside.all():
        gap = 0.0 if planes else GAP * size
        rest = points[~aside]
        whole = objects_of(rest, found.vector, eye, support, gap)
        number[~aside] = _numbered(rest, whole, planes, size)
    return SegmentedScene(
        object=number,
        planes=tuple(planes),
        num_points=tuple(np.bincount(number[number >= 0]).tolist()),
        num_support=int((number == SUPPORT).sum()),
        num_left_over=int((number == LEFT_OVER).sum()),
        up=found,
    )


def _set_aside(
    thinned: Thinned,
    eye: Float64[np.ndarray, "3"] | None,
    camera_rotation: Float[Array | np.ndarray, "3 3"] | None,
) -> tuple[Plane | None, list[Plane], Bool[np.ndarray, " N"]]:
    """The support, other planes, and the points on any of them."""
    points, cells = thinned.points, thinned.cells.points
    support, planes = find_support(thinned, eye, camera_rotation), thinned.planes
    aside, walls = np.zeros(len(points), bool), []
    if len(cells) < 2 or not planes:
        return None, [], aside
    rim = LINK_SPACINGS * thinned.cells.spacing
    inner = np.zeros(len(cells), bool)
    ends = [] if eye is None else bounding(thinned, eye)
    longest = np.inf
    border = None if support is None else outline(cells, support)
    if support is not None and border is not None:
        aside |= _on(support, border, points, rim)
        inner = border.depth(cells) > EDGE * border.width
        longest = border.width
    elif planes[0].holds(cells).mean() >= SHEET:
        return None, planes[:1], planes[0].holds(points)
    elif not ends:
        return None, [], aside
    for plane, border in zip(planes, thinned.borders, strict=True):
        if border is None:
            continue
        on = _on(plane, border, points, rim)
        flat = plane.tolerance <= COARSE * extent(cells) and border.filled >= FILLED
        standing = inner[plane.holds(cells)].mean() > 0.5
        large = flat and not standing and border.length >= longest
        new = (on & ~aside).sum() > 0.5 * on.sum()
        if new and (plane in ends or large):
            walls.append(plane)
            aside |= on
    return support, walls, aside


def _on(
    plane: Plane, border: Outline, points: Float64[np.ndarray, "N 3"], rim: float
) -> Bool[np.ndarray, " N"]:
    """Near the plane and inside its border, or not farther outside than the rim."""
    on = plane.holds(points)
    on[on] = border.depth(points[on]) > -rim
    return on


def _numbered(
    points: Float64[np.ndarray, "N 3"],
    whole: Int[np.ndarray, " N"],
    planes: Sequence[Plane],
    size: float,
) -> Int[np.ndarray, " N"]:
    """Objects by falling number of points, and what is too small left over."""
    count = np.bincount(whole)
    lower, upper = np.full((2, len(count), 3), [[[np.inf]], [[-np.inf]]])
    np.minimum.at(lower, whole, points)
    np.maximum.at(upper, whole, points)
    proper = (count >= MIN_POINTS) & ((upper - lower).max(axis=1) >= MIN_SIZE * size)
    for plane in planes:
        # Noise of a plane itself forms flat patches on it.
        top = np.full(len(count), -np.inf)
        np.maximum.at(top, whole, plane.height(points))
        proper &= np.abs(top) >= 3.0 * plane.tolerance
    order = np.argsort(-np.where(proper, count, 0), kind="stable")
    number = np.full(len(count), LEFT_OVER)
    number[order[: proper.sum()]] = np.arange(proper.sum())
    return number[whole]
