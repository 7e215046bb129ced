"""Maps of what a sensor measured of an object and beside it."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree

from prism_jax.geometry.camera import MIN_DEPTH, Camera
from prism_jax.geometry.cloud import IndexedCloud
from prism_jax.geometry.visibility import (
    BACKGROUND,
    CLOSED,
    MAP_SIZE,
    NEARER,
    SURFACE,
    UNKNOWN,
    WIDEST,
    Background,
    Visibility,
    closed,
    framing_camera,
    look_up,
)
from prism_jax.geometry.workspace import CUBE_MARGIN, Workspace

BEHIND = 0.03  # so near its far side, in half sides, nothing of a workspace is hidden
ABOUT = 2  # what is measured so many pixels away may as well be measured here
MAX_REACH = MAP_SIZE // 8  # in pixels: holes of up to twice that are closed
FEW = 1024  # points by which the spacing of a larger cloud is taken
DENSE = 4 * MAP_SIZE**2  # so many points on a map leave no holes between them
ENOUGH = 5 * MAP_SIZE**2  # points around an object: more say no more, and take longer


def seen_among(
    points: IndexedCloud | Float[np.ndarray, "N 3"],
    around: Float[np.ndarray, "R 3"],
    eye: Float[np.ndarray, "3"],
    workspace: Workspace | None = None,
    background: Background = "unknown",
) -> Visibility:
    """Visibility of an object from a sensor at `eye`: by the object's `points`, and by
    whatever else the sensor measured `around` them in the same scan.

    The points are surface as `prism_jax.geometry.visibility.seen_by` has it: they frame
    the same map, and the same holes between them are closed. A pixel without them shows
    what was measured nearest there: `NEARER` where the workspace goes on behind that
    along the ray, and so is hidden, and `BACKGROUND` where it does not. Holes as
    narrow, in spacings of what was measured around, are closed likewise. Where nothing
    was measured nothing is known, unless the `background` is "empty".

    All in one frame and unit, and so the workspace, which is the cube around the points
    with `CUBE_MARGIN` unless it is given. At least one point. NumPy, in double
    precision but for the depths; not differentiable.
    """
    cloud, around = IndexedCloud.of(points), np.asarray(around, np.float64)
    points, eye = cloud.points, np.asarray(eye, np.float64)
    if workspace is None:
        workspace = Workspace.from_points(points, CUBE_MARGIN)
    camera = framing_camera(points, eye, WIDEST)
    pixel, z = map(np.asarray, camera.pixel_of(points))
    row = _nearest(pixel, z)
    focal = camera.intrinsics[0, 0]
    apart = _spacing(points, cloud.tree) * focal / max(z.mean(), MIN_DEPTH)
    reach = 0.5 * CLOSED * apart
    surface, nearest = closed(row >= 0, float(min(reach, MAX_REACH)))
    state = np.where(surface, SURFACE, UNKNOWN).astype(np.uint8)
    depth = np.where(surface, z[row.ravel()[nearest]], 0.0)
    if background == "empty":
        state[~surface], depth[~surface] = BACKGROUND, 2.0 * z.max()
    pixel, z = map(np.asarray, camera.pixel_of(around))
    around, pixel, z = (rows[pixel < MAP_SIZE**2] for rows in (around, pixel, z))
    if len(around):
        row = _without_holes(_nearest(pixel, z), camera, around)
        beside = ~surface & (row >= 0)
        row = row[beside]
        hides = _hides(around[row], z[row], eye, workspace)
        state[beside] = np.where(hides, NEARER, BACKGROUND)
        depth[beside] = z[row]
    return Visibility(camera, state, depth.astype(np.float32))


def some_of(around: Float[np.ndarray, "R 3"]) -> Float[np.ndarray, "S 3"]:
    """About `ENOUGH` of many points, drawn at random, the same each time. Evenly spaced
    rows of an image would be a few of its columns."""
    if len(around) <= ENOUGH:
        return around
    drawn = np.random.default_rng(0).random(len(around), np.float32)
    return around[drawn < ENOUGH / len(around)]


def in_free_space(
    points: Float[np.ndarray, "P 3"],
    visibility: Visibility,
    tolerance: float,
    about: int = ABOUT,
) -> Bool[np.ndarray, " P"]:
    """Which points a sensor looked past the object and through: all that it measured
    so many pixels `about` theirs, rows and columns alike, lies more than `tolerance`
    behind them, and in their own pixel it is not the object.

    None where nothing was measured, and none beside the map. One frame and unit. NumPy.
    """
    state, depth = map(np.asarray, visibility[1:])
    # Between points and at edges a pixel's own depth is a neighbour's.
    depth = np.where(state == UNKNOWN, np.inf, depth)
    depth = minimum_filter(depth, 2 * about + 1, mode="constant", cval=np.inf)
    state, behind = look_up(Visibility(visibility.camera, state, depth), points)
    return np.asarray((state > SURFACE) & (behind < -tolerance))


def box_exit(
    eye: Float[np.ndarray, "3"],
    rays: Float[np.ndarray, "P 3"],
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " P"]:
    """Where each ray from an eye leaves a box, in its own lengths; 0 if it misses."""
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = (lower - eye) / rays, (upper - eye) / rays
    entry = np.minimum(*sides).max(axis=1)
    leave = np.maximum(*sides).min(axis=1)
    return np.where(leave > np.maximum(entry, 0), leave, 0.0)


def _nearest(
    pixel: Int[np.ndarray, " N"], z: Float[np.ndarray, " N"]
) -> Int[np.ndarray, "H W"]:
    """The row of the nearest of those in each pixel; -1 without any."""
    row = np.full(MAP_SIZE**2 + 1, -1)
    order = np.argsort(-z, kind="stable")
    # The last of those that fall on a pixel stays.
    row[pixel[order]] = order
    return row[:-1].reshape(MAP_SIZE, MAP_SIZE)


def _without_holes(
    row: Int[np.ndarray, "H W"], camera: Camera, around: Float[np.ndarray, "R 3"]
) -> Int[np.ndarray, "H W"]:
    """The same with the nearest pixel's row in narrow holes between them."""
    if len(around) > DENSE:
        return row
    in_camera = np.asarray(camera.to_camera(around))
    focal = float(camera.intrinsics[0, 0])
    image = focal * in_camera[:, :2] / in_camera[:, 2:]
    tree = KDTree(image, compact_nodes=False, balanced_tree=False)
    reach = float(min(0.5 * CLOSED * _spacing(image, tree), MAX_REACH))
    # What lies beyond the map's edge is not known, and so no side of a hole.
    known, nearest = closed(np.pad(row >= 0, MAX_REACH), reach)
    inside = slice(MAX_REACH, MAX_REACH + MAP_SIZE)
    padded = np.pad(row, MAX_REACH, constant_values=-1)
    return np.where(known, padded.ravel()[nearest], -1)[inside, inside]


def _hides(
    points: Float[np.ndarray, "P 3"],
    z: Float[np.ndarray, " P"],
    eye: Float[np.ndarray, "3"],
    workspace: Workspace,
) -> Bool[np.ndarray, " P"]:
    """Whether the cube goes on behind points that were seen from `eye` at depth `z`."""
    unit, ends = (np.asarray(workspace.to_unit(one)) for one in (eye, points))
    rays = (ends - unit) / z[:, None]
    far = box_exit(unit, rays, -np.ones(3), np.ones(3))
    return far > z + BEHIND * float(workspace.half_extent)


def _spacing(points: Float[np.ndarray, "N D"], tree: KDTree) -> float:
    """Median distance of points, evenly spaced rows, from their nearest neighbours;
    infinite for one."""
    some = points[:: -(-len(points) // FEW)]
    return float(np.median(tree.query(some, k=2)[0][:, 1]))
