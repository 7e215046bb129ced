"""Free space: what measured rays prove to be empty."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from prism_jax.envelope.voxels import Grid
from prism_jax.geometry.camera import MIN_DEPTH, Camera, Vector
from prism_jax.io.errors import InputError

MAX_CELLS = 8_000_000  # of a range image: a finer one is not made

LEVELS = 5  # range images that are made of a cloud, each twice as coarse as the last

AGREE = 0.5  # of a scan's points lie on the surface of its depth image

ON, PASSED = 0.05, 0.25
"""Of a known robot's surface so much lies at least on what was measured; and of what
was measured of it or beyond, rays passed through so much at most."""

CONFLICTS = 0.01  # of the voxels with measured points may be called free, at most

BESIDE = 32  # cells of them beside the voxels, for holes that reach beyond


class Carving(NamedTuple):
    """What it takes for a voxel to be free."""

    # How far behind the whole voxel everything must have been measured, in units of
    # length: for errors of the measured depths and of the sensor's pose.
    margin: float = 0.04
    # The diameter of the smallest ball that free space must not hold.
    body: float = 0.02


class DepthView:
    """A depth image: one measured ray a pixel, through its centre.

    Depths are along the camera's z, and infinite where nothing was measured.
    """

    def __init__(self, depth: Float[np.ndarray, "H W"], camera: Camera):
        """Nothing was measured where `depth` is not above zero."""
        self.depth = np.where(depth > 0, depth, np.inf).astype(np.float64)
        self.camera = camera

    def ranges(
        self, points: Float[np.ndarray, "N 3"], margin: float
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """How far points are, and what was measured there; infinite if nothing was."""
        pixel, z = map(np.asarray, self.camera.pixel_of(np.asarray(points, np.float64)))
        depth = np.append(self.depth.ravel(), np.inf)
        return z, depth[np.minimum(pixel, self.depth.size)]

    def carve(self, grid: Grid, carving: Carving) -> Bool[np.ndarray, "X Y Z"]:
        """The voxels that are free; see `carve`."""
        corners = _corners_in_image(grid, self.camera)
        least, most = (
            of_eight(corners, (1, 2, 2, 2))[:, 1:, 1:, 1:].reshape(3, -1)
            for of_eight in (ndimage.minimum_filter, ndimage.maximum_filter)
        )
        which = np.flatnonzero(least[2] > MIN_DEPTH)
        first, last = (ends[:2, which].T.astype(int) for ends in (least, most))
        pitch = 1.0 / np.diag(np.asarray(self.camera.intrinsics, np.float64))[:2].min()
        sure = proven(self.depth, pitch, carving.body, cells=False)
        free = np.zeros(grid.shape, bool)
        shown = _least(sure, first - 1, last + 1)
        free.ravel()[which] = shown > most[2, which] + sum(carving)
        return free


class CloudView:
    """A cloud and the place of its sensor: rays that were measured, in any pattern, all
    around it or not."""

    def __init__(self, points: Float[np.ndarray, "N 3"], eye: Vector):
        """Every point is what a ray from `eye` measured."""
        self.points, self.eye = np.asarray(points, np.float64), np.asarray(eye, float)

    def ranges(
        self, points: Float[np.ndarray, "N 3"], margin: float
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """As of `DepthView`, by the nearest ray if it passes within the margin."""
        far = np.linalg.norm(points - self.eye, axis=1)
        if len(self.points) == 0:
            return far, np.full(len(points), np.inf)
        length = np.linalg.norm(self.points - self.eye, axis=1)
        tree = KDTree((self.points - self.eye) / np.maximum(length, 1e-300)[:, None])
        away, row = tree.query((points - self.eye) / np.maximum(far, 1e-300)[:, None])
        return far, np.where(away * far <= margin, length[row], np.inf)

    def carve(self, grid: Grid, carving: Carving) -> Bool[np.ndarray, "X Y Z"]:
        """The voxels that are free; see `carve`.

        The rays are sorted into cells of azimuth and elevation, and the nearest of each
        counts. What one size of cell proves is proven, so several are tried.
        """
        free = np.zeros(grid.shape, bool)
        toward = 0.5 * (grid.lower + grid.upper) - self.eye
        # The poles, where nothing is proven, are away from the grid's middle.
        axes = np.roll(np.arange(3), 2 - np.abs(toward).argmin())
        heading = math.atan2(*toward[axes[1::-1]])
        rays, length = _angles((self.points - self.eye)[:, axes], heading)
        middles = (grid.centers() - self.eye)[:, axes]
        least, most, far = _voxels_around(middles, grid.voxel, heading, carving.body)
        reach = far.max(initial=0.0, where=np.isfinite(far))
        for level in range(LEVELS):
            # The largest cells in which a ball is noticed that far away.
            distance = max(reach / 2**level, carving.body)
            pitch = carving.body / (2.0 * math.sqrt(2.0) * distance)
            first, last = (np.floor(ends / pitch).astype(int) for ends in (least, most))
            corner = first.min(axis=0) - BESIDE
            shape = last.max(axis=0) - corner + BESIDE
            if np.prod(shape) > MAX_CELLS:
                continue
            image = np.full(shape, np.inf)
            for turn in (-2 * np.pi, 0.0, 2 * np.pi):
                cell = np.floor((rays + [0.0, turn]) / pitch).astype(int) - corner
                held = ((cell >= 0) & (cell < shape)).all(axis=1)
                np.minimum.at(image, tuple(cell[held].T), length[held])
            sure = proven(image, pitch, carving.body, cells=True)
            shown = _least(sure, first - corner - 2, last - corner + 2)
            free |= (shown > far + sum(carving)).reshape(grid.shape)
        return free


View = DepthView | CloudView


def carve(
    grid: Grid, view: View, carving: Carving = Carving()
) -> Bool[np.ndarray, "X Y Z"]:
    """The voxels that measured rays prove to be free.

    A voxel is free if on all pixels that it covers, and those around them, what
    `proven` gives lies behind it, by the `margin` and the diameter of the smallest
    `body`. Then no opaque body crosses it that is a union of balls of that diameter,
    whether it returns light or not, as long as measured depths and the sensor's pose
    are right within the margin.

    Proof. Say that such a body crosses a free voxel. Then so does a ball of diameter d
    inside the body, no part of which lies farther than d behind the voxel. A ray that
    meets the ball returns nothing, or a depth that is not behind the voxel by the
    margin and d: call its pixel bad (of a cloud: a cell all of whose rays meet it). The
    ball's image holds a square of n x n bad pixels, connected by bad ones to one that
    the voxel covers or that is next to those (of cells: at most two away). Were that
    one measured, the voxel would not be free. So it is in a hole. If the whole image is
    in the hole, n x n pixels fit into that, and `proven` is nearer than the voxel. If
    not, a bad pixel at the hole's border was measured, and `proven` is no farther than
    that. If n is 0, the ball is too small to be noticed there, and `proven` is nearer
    than the voxel. That the bad pixels of a ball are connected is tested, not proven.

    Grid and view are in one frame and unit; NumPy, not differentiable.
    """
    return view.carve(grid, carving)


def compare(
    view: View, points: Float[np.ndarray, "N 3"], margin: float
) -> tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Which points lie on what was measured, and through which a measured ray passed,
    both by the margin. The others are hidden, or nothing was measured there."""
    far, measured = view.ranges(points, margin)
    on = np.abs(measured - far) <= margin
    return on, np.isfinite(measured) & (measured > far + margin)


def check_agreement(
    view: View, points: Float[np.ndarray, "N 3"], carving: Carving
) -> None:
    """Raises InputError if less than half of a scan's points lie on the surface of its
    depth image, within the carving margin."""
    agree = compare(view, points, carving.margin)[0].mean() if len(points) else 1.0
    if agree < AGREE:
        fault = f"only {agree:.0%} of the scan's points lie on the depth image"
        remedy = "check the camera's pose, depth_scale, and the units of both"
        raise InputError("the depth image", fault, remedy)


def check_robot(
    view: View, surface: Float[np.ndarray, "R 3"], carving: Carving
) -> None:
    """Raises InputError if a known robot's surface is not where the scan shows it: see
    `ON` and `PASSED`."""
    on, passed = (some.sum() for some in compare(view, surface, carving.margin))
    if on < ON * len(surface) or passed > PASSED * (on + passed):
        fault = (
            f"{on / len(surface):.0%} of its surface lies on measured points ({ON:.0%} "
            f"at least), and rays pass through {passed / max(on + passed, 1):.0%} of "
            f"what they should hit ({PASSED:.0%} at most)"
        )
        remedy = "check --base, --joints and the model; without --urdf it is unknown"
        raise InputError("the robot", fault, remedy)


def check_conflicts(
    grid: Grid, free: Bool[np.ndarray, "X Y Z"], measured: Float[np.ndarray, "N 3"]
) -> None:
    """Raises InputError if over a hundredth of the voxels that hold a measured point
    are called free: the rays and the points do not belong together."""
    index = grid.index_of(measured)
    held = np.unique(index[index >= 0])
    wrong = int(free.ravel()[held].sum())
    if wrong > CONFLICTS * len(held):
        fault = f"{wrong:,} of {len(held):,} voxels with points are called free"
        remedy = "check the sensor's position, its pose, and the units"
        raise InputError("the view", fault, remedy)


def proven(
    depth: Float[np.ndarray, "H W"], pitch: float, body: float, cells: bool
) -> Float[np.ndarray, "H W"]:
    """How far each pixel's rays prove that no ball of a diameter crosses them.

    `depth` is what was measured, infinite where nothing was; `pitch` the tangent or
    angle between pixels. A ball is noticed as far away as it fills a pixel. A hole, of
    pixels without a measurement that touch at sides or corners, proves no more than the
    nearest depth at its border, nor farther than where a ball would fit into it. What
    is outside of the image is a hole without a border.
    """
    padded = np.pad(depth, 1, constant_values=np.inf)
    hole = ~np.isfinite(padded)
    found: Any = ndimage.label(hole, np.ones((3, 3)))
    number, count = found
    outside = number[0, 0]
    # The side of the largest square of pixels in each hole.
    side = np.zeros(count + 1)
    square = hole & (number != outside)
    while square.any():
        side[np.unique(number[: square.shape[0], : square.shape[1]][square])] += 1
        square = square[1:, 1:] & square[1:, :-1] & square[:-1, 1:] & square[:-1, :-1]
    side[outside] = np.inf
    nearest = ndimage.minimum_filter(padded, 3)
    border = ndimage.minimum(nearest, number, np.arange(count + 1))
    # As far as a ball's image holds a square that is larger than the hole.
    reach = body / math.sqrt(2.0) / pitch / (side + (2.0 if cells else 1.0))
    limit = np.minimum(border, reach)
    shown = np.where(hole, limit[number], np.minimum(padded, reach[0]))
    return shown[1:-1, 1:-1]


def _angles(
    rays: Float[np.ndarray, "N 3"], heading: float
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]:
    """Elevation, azimuth from a heading on, and length."""
    flat = np.hypot(rays[:, 0], rays[:, 1])
    azimuth = np.arctan2(rays[:, 1], rays[:, 0]) - heading
    azimuth = (azimuth + np.pi) % (2 * np.pi) - np.pi
    elevation = np.arctan2(rays[:, 2], flat)
    return np.stack([elevation, azimuth], axis=1), np.hypot(flat, rays[:, 2])


def _voxels_around(
    rays: Float[np.ndarray, "V 3"], voxel: float, heading: float, body: float
) -> tuple[Float[np.ndarray, "V 2"], Float[np.ndarray, "V 2"], Float[np.ndarray, " V"]]:
    """Of each voxel about a ray's end its least and its largest elevation and azimuth,
    and the distance of its farthest corner; outer bounds of all. Near the poles, where
    a body may be on all azimuths, the distance is infinite."""
    half = 0.5 * voxel
    inner = np.maximum(np.abs(rays[:, :2]) - half, 0.0)
    nearest, farthest = np.hypot(*inner.T), np.hypot(*(np.abs(rays[:, :2]) + half).T)
    around = np.maximum(np.hypot(*rays[:, :2].T), 1e-300)
    width = np.arcsin(np.minimum(half * math.sqrt(2.0) / around, 1.0))
    bottom, top = rays[:, 2] - half, rays[:, 2] + half
    low = np.arctan2(bottom, np.where(bottom > 0, farthest, nearest))
    high = np.arctan2(top, np.where(top > 0, nearest, farthest))
    azimuth = _angles(rays, heading)[0][:, 1]
    far = np.linalg.norm(np.abs(rays) + half, axis=1)
    far[around < 4.0 * (half + body)] = np.inf
    least = np.stack([low, azimuth - width], axis=1)
    return least, np.stack([high, azimuth + width], axis=1), far


def _corners_in_image(grid: Grid, camera: Camera) -> Float[np.ndarray, "3 X1 Y1 Z1"]:
    """Pixel row, pixel column and depth of every corner of every voxel."""
    steps = [np.arange(count + 1) * grid.voxel for count in grid.shape]
    corners = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    rotation = np.asarray(camera.rotation, np.float64)
    offset = rotation @ grid.lower + np.asarray(camera.translation, np.float64)
    in_camera = corners @ rotation.T + offset
    z = in_camera[:, 2]
    image = in_camera @ np.asarray(camera.intrinsics, np.float64).T
    pixels = np.floor(image[:, :2] / np.where(z > MIN_DEPTH, z, 1.0)[:, None] + 0.5)
    found = np.stack([pixels[:, 1], pixels[:, 0], z])
    return found.reshape(3, *(count + 1 for count in grid.shape))


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
    # What is outside of the image proves nothing.
    inside = ((first >= 0) & (last < np.array(image.shape))).all(axis=1)
    first, last = first[inside], last[inside]
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
    found = np.zeros(inside.shape)
    found[inside] = least
    return found
