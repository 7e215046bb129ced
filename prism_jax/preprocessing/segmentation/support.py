"""The plane that objects stand on, and with it the way up."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Float64

from prism_jax.geometry.camera import Vector
from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.preprocessing.segmentation.background import bounding
from prism_jax.preprocessing.segmentation.clusters import components
from prism_jax.preprocessing.segmentation.planes import Outline, Plane, Thinned
from prism_jax.preprocessing.upright import AUTO, upright

RIM = 0.01  # how far from a plane's border something is inside or outside, in its width
WITHIN = 0.6  # the share of a cloud over, on or under a support, seen along its normal
FLAT = 0.4  # the share of that which lies on the support
BELOW = 0.15  # as many points as this, for each above a support, may lie below it
LARGE = 0.7  # a plane so long, in a support's width, is a wall or another floor
# In the shorter one's length: so far, at one end, one of two planes that cross goes on
# where the other is over, unless they are faces of one thing.
BEYOND = 0.2
PARALLEL = 30.0  # in degrees: planes that cross at less have no line in common
FILLED = 0.5  # the share of a support's outline that has points
MIN_CELLS = 10  # what stands on a support has so many cells of the thinned cloud
MAX_TILT = 60.0  # in degrees from z, of a support whose side no sensor says
SQUARE = np.cos(np.deg2rad(45.0))  # a sensor looks at a plane rather straight on
STEEP = np.cos(np.deg2rad(80.0))  # so far from level for an upright camera is a wall
LINK_SPACINGS = 4.0  # points no farther apart than so many spacings hang together


class Up(NamedTuple):
    """Which way is up, and what says so."""

    vector: Float64[np.ndarray, "3"]  # of unit length, in the points' frame
    # The normal of the "support" plane, the "camera" that was held upright, or "z", the
    # axis that is taken if nothing says more, or it was "given".
    source: Literal["support", "camera", "z", "given"]


def given_up(up: str | Vector) -> Up:
    """An up as `upright` has it."""
    turn = upright(up)
    return Up(np.array([0.0, 0.0, 1.0]) if turn is None else turn[2], "given")


def tilt_of(planes: Sequence[Plane], up: str | Vector) -> float:
    """By how many degrees the plane that is nearest to level is tilted against an up
    that was given; 0 if it is a wall, or there is none."""
    if isinstance(up, str) and up == AUTO:
        return 0.0
    vector = given_up(up).vector
    tilts = [np.degrees(np.arccos(min(abs(p.normal @ vector), 1.0))) for p in planes]
    return float(min((tilt for tilt in tilts if tilt < MAX_TILT), default=0.0))


def find_up(
    points: Thinned | Float[np.ndarray, "N 3"],
    sensor: Vector | None = None,
    camera_rotation: Float[Array | np.ndarray, "3 3"] | None = None,
) -> Up:
    """Up by the support plane; without one by the camera; without that, z.

    `sensor` is as for `find_support`. `camera_rotation` is a known orientation of the
    camera in the points' frame (`Camera.rotation`): up is then against its y axis,
    which points down in the image.
    """
    support = find_support(points, sensor, camera_rotation)
    if support is not None:
        return Up(support.normal, "support")
    if camera_rotation is not None:
        up = -np.asarray(camera_rotation, np.float64)[1]
        return Up(up / np.linalg.norm(up), "camera")
    return Up(np.array([0.0, 0.0, 1.0]), "z")


def find_support(
    points: Thinned | Float[np.ndarray, "N 3"],
    sensor: Vector | None = None,
    camera_rotation: Float[Array | np.ndarray, "3 3"] | None = None,
) -> Plane | None:
    """The plane that objects stand on: a table, a floor; None if there is none.

    Of the large planes it is the one that most stands on, on the sensor's side, with
    next to nothing on the other. An object stands on it if most of it projects inside
    the plane's border, if it is not higher than the plane is wide, and if it touches
    the plane or hovers by no more than its own height (its foot may be hidden); what
    hovers counts for less. Most of the cloud must lie over the plane, and much of that
    on it, other planes about as large left aside (`_is_elsewhere`). A face of an object
    is no support: what is joined to it goes beyond its border or lies behind it.
    Neither is a table with nothing on it, which could be a wall.

    The normal points to the objects. `sensor` is the place the points were seen from.
    If it is None or not finite, the objects' side is that of z, and a plane tilted from
    it by over `MAX_TILT` is none: inner sides of single objects would pass. With a
    `camera_rotation`, a plane that is steep for an upright camera is none beside one
    about as large that is level. Alone it can be a table seen from above.
    """
    thinned = points if isinstance(points, Thinned) else Thinned(points)
    cells, planes, borders = thinned.cells.points, thinned.planes, thinned.borders
    eye = None
    if sensor is not None and np.isfinite(np.asarray(sensor)).all():
        eye = np.asarray(sensor, np.float64)
    ends = [] if eye is None else bounding(thinned, eye)
    forward = np.zeros(3) if eye is None else (cells - eye).sum(axis=0)
    best, most = None, 0.0
    # By how much each plane faces the way up of an upright camera.
    sides = [_objects_side(plane, eye) for plane in planes]
    above = np.zeros(3) if camera_rotation is None else -np.asarray(camera_rotation)[1]
    faces = [0.0 if side is None else float(side.normal @ above) for side in sides]
    flat = [b.length for b, f in zip(borders, faces, strict=True) if b and f >= SQUARE]
    for plane, side, border, face in zip(planes, sides, borders, faces, strict=True):
        if side is None or border is None:
            continue
        if flat and face < STEEP and max(flat) >= LARGE * border.width:
            continue  # a wall, beside a plane about as large that is level
        aside = np.zeros(len(cells), bool)
        for other, its in zip(planes, borders, strict=True):
            if its is None or its.length < LARGE * border.width:
                continue
            both_end_the_view = other in ends and plane in ends
            if both_end_the_view or _is_elsewhere(other, plane, border, cells):
                aside |= other.holds(cells)
        aside &= ~plane.holds(cells)
        # A wall, or a table from above: what stands on that is seen to touch it.
        square = abs(side.normal @ forward) > SQUARE * np.linalg.norm(forward)
        standing = _standing(thinned.cells, aside, side, border, bool(square))
        if standing > most:
            best, most = side, standing
    return best


def _is_elsewhere(
    other: Plane, plane: Plane, border: Outline, cells: Float64[np.ndarray, "N 3"]
) -> bool:
    """Whether another plane is a wall, or another floor, and no face of the same thing.

    The side and the back of a shelf begin and end together along the line that they
    share; one of a table and a wall goes on beyond the other by `BEYOND`. A parallel
    plane is another floor if most of it lies outside the `border` of this one.
    """
    its = cells[other.holds(cells)]
    line = np.cross(plane.normal, other.normal)
    sine = np.linalg.norm(line)
    if sine <= np.sin(np.deg2rad(PARALLEL)):
        return bool((border.depth(its) < -RIM * border.width).mean() > 0.5)
    on = cells[plane.holds(cells)]
    ends = np.array([np.percentile(part @ line, [1, 99]) for part in (on, its)])
    shorter = np.ptp(ends, axis=1).min()
    return bool(np.abs(ends[0] - ends[1]).max() >= BEYOND * shorter)


def _objects_side(plane: Plane, eye: Float64[np.ndarray, "3"] | None) -> Plane | None:
    """The plane with its normal to where objects can be, if they can be anywhere."""
    if eye is not None:
        positive = plane.height(eye[None])[0] > 0
    elif np.abs(plane.normal[2]) < np.cos(np.deg2rad(MAX_TILT)):
        return None
    else:
        positive = plane.normal[2] > 0
    if positive:
        return plane
    return Plane(-plane.normal, -plane.offset, plane.tolerance)


def _standing(
    cloud: IndexedCloud,
    aside: Bool[np.ndarray, " N"],
    plane: Plane,
    border: Outline,
    touching: bool,
) -> float:
    """How many cells stand on a plane, those set aside left out; zero if it is none
    that objects stand on. What hovers does not count if all have to be `touching`."""
    reach = LINK_SPACINGS * cloud.spacing
    cells = cloud.points
    height, depth = plane.height(cells), border.depth(cells)
    rim = RIM * border.width
    above = (depth > -rim) & (height > plane.tolerance)
    below = (depth > -rim) & (height < -2.0 * plane.tolerance)
    height, depth = height[~aside], depth[~aside]
    over = depth > -rim
    on = np.abs(height) <= plane.tolerance
    off = height > plane.tolerance
    large = (
        over.mean() >= WITHIN
        and border.count >= FLAT * (border.count + (over & ~on).sum())
        and border.filled >= FILLED
    )
    if not large or below.sum() > BELOW * above.sum() or not off.any():
        return 0.0

    group = components(cells[~aside][off], np.full(off.sum(), reach))
    size = np.bincount(group)
    top, foot = np.zeros(len(size)), np.full(len(size), np.inf)
    np.maximum.at(top, group, height[off])
    np.minimum.at(foot, group, height[off])
    hovering = np.maximum(foot - plane.tolerance - reach, 0.0) / (0.5 * top)
    if touching:
        hovering = np.sign(hovering)
    enclosed = np.bincount(group, depth[off] > rim) >= 0.7 * size
    proper = (size >= MIN_CELLS) & (top >= 3.0 * plane.tolerance)
    proper &= (top <= border.width) & enclosed
    return float((size * np.maximum(1.0 - hovering, 0.0))[proper].sum())
