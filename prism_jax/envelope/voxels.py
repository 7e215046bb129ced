"""A grid over a workspace in which each voxel is in one of five states.

Free is only what measured rays passed through, with a margin. A completion takes
nothing away from that: it adds what may be taken, and unseen space stays unseen.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Float64, Int, UInt8

from prism_jax.geometry.camera import MIN_DEPTH, Camera, Vector
from prism_jax.geometry.visibility import (
    SURFACE,
    UNKNOWN,
    Background,
    Visibility,
    seen_by,
)
from prism_jax.io.errors import InputError

MEASURED, ROBOT, PREDICTED, UNSEEN, FREE = range(5)
STATES = ("measured", "robot", "predicted", "unseen", "free")
"""States of a voxel, by their numbers. All but the last may hold something."""

VOXEL = 0.04  # the side of a voxel, in metres

MAX_VOXELS = 20_000_000  # of a grid; a finer one takes more memory than it is worth

MAX_ASKED = 4096
"""Points of a cloud that its view is made of; of more, evenly spaced rows."""


class Carving(NamedTuple):
    """What it takes for a voxel to be free."""

    # How far behind the whole voxel something must have been measured, along the
    # camera's axis, in units of length.
    margin: float = 0.04
    # Of the pixels that the voxel covers, those on which anything was measured.
    share: float = 0.5


@dataclasses.dataclass(frozen=True)
class Grid:
    """Cubes of one size that fill a box."""

    lower: Float64[np.ndarray, "3"]  # the box's corner with the least coordinates
    voxel: float  # the side of each cube, in the unit of `lower`
    shape: tuple[int, int, int]  # how many there are along x, y and z

    @classmethod
    def over(
        cls,
        lower: Float[np.ndarray, "3"],
        upper: Float[np.ndarray, "3"],
        voxel: float = VOXEL,
    ) -> "Grid":
        """The smallest grid at `lower` that reaches `upper`; one voxel at least.

        A box or a voxel that is none, and more than `MAX_VOXELS`, raise InputError.
        """
        lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        if not (np.isfinite(voxel) and voxel > 0):
            raise InputError("voxel", f"invalid size {voxel}", "give a positive length")
        if not (np.isfinite([lower, upper]).all() and (upper >= lower).all()):
            fault = f"not a box: {lower.tolist()} to {upper.tolist()}"
            raise InputError("workspace", fault, "give a lower and an upper corner")
        # What ends at a voxel's face up to rounding needs no voxel more.
        counts = np.maximum(np.ceil((upper - lower) / voxel - 1e-6), 1)
        if np.prod(counts) > MAX_VOXELS:
            fault = f"{np.prod(counts):,.0f} voxels of size {voxel:g} are too many"
            remedy = f"use a smaller box or larger voxels ({MAX_VOXELS:,} at most)"
            raise InputError("workspace", fault, remedy)
        x, y, z = (int(count) for count in counts)
        return cls(lower, float(voxel), (x, y, z))

    @property
    def upper(self) -> Float64[np.ndarray, "3"]:
        """The opposite corner."""
        return self.lower + self.voxel * np.array(self.shape)

    @property
    def half_diagonal(self) -> float:
        """From a voxel's middle to its corners."""
        return 0.5 * math.sqrt(3.0) * self.voxel

    def centers(self) -> Float64[np.ndarray, "V 3"]:
        """The middles of all voxels, z fastest."""
        return self.middles(np.arange(math.prod(self.shape)))

    def middles(self, index: Int[np.ndarray, " N"]) -> Float64[np.ndarray, "N 3"]:
        """The middles of voxels by their numbers."""
        steps = np.stack(np.unravel_index(index, self.shape), axis=1)
        return self.lower + self.voxel * (steps + 0.5)

    def index_of(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
        """The number of the voxel that holds each point; -1 outside of the grid.

        The grid's own border belongs to it. What is not finite is outside.
        """
        points = np.asarray(points, np.float64)
        inside = ((points >= self.lower) & (points <= self.upper)).all(axis=1)
        steps = np.floor((points[inside] - self.lower) / self.voxel).astype(int)
        steps = np.clip(steps, 0, np.array(self.shape) - 1)
        index = np.full(len(points), -1)
        index[inside] = np.ravel_multi_index(tuple(steps.T), self.shape)
        return index


def view_of_depth(
    depth: Float[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"], camera: Camera
) -> Visibility:
    """A depth image as a map of what its camera knows.

    `depth` is along the camera's z, `mask` says where anything was measured. A pixel
    without a return knows nothing.
    """
    state = np.where(mask, SURFACE, UNKNOWN).astype(np.uint8)
    return Visibility(camera, state, np.where(mask, depth, 0.0).astype(np.float32))


def view_of_cloud(
    points: Float[np.ndarray, "N 3"], eye: Vector, background: Background = "unknown"
) -> Visibility:
    """What a cloud says of the view of the sensor at `eye`, by `seen_by`.

    Any number of points, in any frame; of more than `MAX_ASKED`, evenly spaced rows.
    From fewer than two nothing is known of what is between them.
    """
    points, eye = np.asarray(points, np.float64), np.asarray(eye, np.float64)
    points = points[:: max(1, -(-len(points) // MAX_ASKED))]
    if len(points) < 2 or not np.ptp(points, axis=0).any():
        empty = np.zeros((1, 1))
        camera = Camera(np.eye(3), -eye, np.eye(3), 1, 1)
        return view_of_depth(empty, empty > 0, camera)
    # In single precision, so about the eye.
    near = (points - eye).astype(np.float32)
    seen = _seen_by(near, np.zeros(3, np.float32), background)
    seen = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), seen)
    camera = dataclasses.replace(
        seen.camera, translation=seen.camera.translation - seen.camera.rotation @ eye
    )
    return Visibility(
        camera, seen.state.astype(np.uint8), seen.depth.astype(np.float32)
    )


_seen_by = jax.jit(seen_by, static_argnames="background")


def carve(
    grid: Grid, view: Visibility, carving: Carving = Carving()
) -> Bool[np.ndarray, "X Y Z"]:
    """The voxels that are free: every ray that was measured through them went on.

    A voxel is free if it is wholly in the image, if on a `share` of the pixels that it
    covers, and of those around them, something was measured, and if all of that lies
    more than `margin` behind the voxel's farthest corner. Where nothing was measured
    nothing is free. Grid and view are in one frame and unit; NumPy, not differentiable.
    """
    known = np.asarray(view.state) != UNKNOWN
    if not known.any():
        return np.zeros(grid.shape, bool)
    row, column, z = _corners_in_image(grid, view.camera)
    (top, bottom), (left, right) = _span(row), _span(column)
    nearest, farthest = _span(z)
    inside = (nearest > MIN_DEPTH) & (top >= 0) & (left >= 0)
    inside &= (bottom < view.camera.height) & (right < view.camera.width)
    which = np.nonzero(inside.ravel())[0]
    first, last = (
        np.stack([rows.ravel()[which], columns.ravel()[which]], axis=1).astype(int)
        for rows, columns in ((top, left), (bottom, right))
    )
    # An edge can pass between two pixels' rays.
    first = np.maximum(first - 1, 0)
    last = np.minimum(last + 1, np.array(known.shape) - 1)
    depth = np.where(known, np.asarray(view.depth, np.float64), np.inf)
    wanted = np.maximum(carving.share * np.prod(last - first + 1, axis=1), 1)
    seen = _count(known, first, last) >= wanted
    passed = _least(depth, first, last) > farthest.ravel()[which] + carving.margin
    free = np.zeros(grid.shape, bool)
    free.ravel()[which] = seen & passed
    return free


def label(
    grid: Grid,
    free: Bool[np.ndarray, "X Y Z"],
    measured: Float[np.ndarray, "N 3"],
    predicted: Float[np.ndarray, "P 3"],
    robot: Float[np.ndarray, "R 3"],
) -> UInt8[np.ndarray, "X Y Z"]:
    """The state of each voxel: what was measured in it, before what is known of the
    robot, before what is predicted, before whether it was seen.

    A predicted point takes a voxel from free space, and gives none back. Points outside
    of the grid have no voxel.
    """
    state = np.where(free, FREE, UNSEEN).astype(np.uint8)
    for points, name in ((predicted, PREDICTED), (robot, ROBOT), (measured, MEASURED)):
        index = grid.index_of(points)
        state.ravel()[index[index >= 0]] = name
    return state


def _corners_in_image(
    grid: Grid, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel row, pixel column and depth of every corner of every voxel."""
    steps = [np.arange(count + 1) * grid.voxel for count in grid.shape]
    corners = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    rotation = np.asarray(camera.rotation, np.float64)
    offset = rotation @ grid.lower + np.asarray(camera.translation, np.float64)
    in_camera = corners @ rotation.T + offset
    z = in_camera[:, 2]
    image = in_camera @ np.asarray(camera.intrinsics, np.float64).T
    pixels = np.floor(image[:, :2] / np.where(z > MIN_DEPTH, z, 1.0)[:, None] + 0.5)
    shape = tuple(count + 1 for count in grid.shape)
    return tuple(values.reshape(shape) for values in (pixels[:, 1], pixels[:, 0], z))  # pyright: ignore


def _span(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest value at the eight corners of each voxel."""
    least = largest = corners
    for axis in range(3):
        ahead = [slice(None)] * 3
        ahead[axis] = slice(1, None)
        behind = [slice(None)] * 3
        behind[axis] = slice(None, -1)
        least = np.minimum(least[tuple(ahead)], least[tuple(behind)])
        largest = np.maximum(largest[tuple(ahead)], largest[tuple(behind)])
    return least, largest


def _count(
    marked: Bool[np.ndarray, "H W"],
    first: Int[np.ndarray, "N 2"],
    last: Int[np.ndarray, "N 2"],
) -> Int[np.ndarray, " N"]:
    """Marked pixels in each rectangle, both corners included, by one summed table."""
    table = np.pad(np.cumsum(np.cumsum(marked, axis=0), axis=1), ((1, 0), (1, 0)))
    (top, left), (bottom, right) = first.T, last.T + 1
    return (
        table[bottom, right]
        - table[top, right]
        - table[bottom, left]
        + table[top, left]
    )


def _least(
    image: Float[np.ndarray, "H W"],
    first: Int[np.ndarray, "N 2"],
    last: Int[np.ndarray, "N 2"],
) -> Float[np.ndarray, " N"]:
    """The least value in a square about each rectangle, both corners included.

    Squares of a power of two as side are put in each of its corners, and reach beyond
    the rectangle where it is narrower than that: the least value is never above the
    rectangle's own.
    """
    sides = (last - first + 1).max(axis=1, initial=1)
    levels = np.floor(np.log2(sides)).astype(int)
    least = np.full(len(first), np.inf)
    squares = image
    for level in range(levels.max(initial=0) + 1):
        side = 2**level
        mine = np.nonzero(levels == level)[0]
        highest = np.maximum(np.array(image.shape) - side, 0)
        near = np.minimum(first[mine], highest)
        far = np.clip(last[mine] - side + 1, 0, highest)
        for rows in (near[:, 0], far[:, 0]):
            for columns in (near[:, 1], far[:, 1]):
                least[mine] = np.minimum(least[mine], squares[rows, columns])
        # A square of twice the side; at the image's edge, what there is of it.
        down = np.pad(squares, ((0, side), (0, 0)), constant_values=np.inf)[side:]
        squares = np.minimum(squares, down)
        across = np.pad(squares, ((0, 0), (0, side)), constant_values=np.inf)
        squares = np.minimum(squares, across[:, side:])
    return least
