"""A model's surface as sensors see it from outside, and what finds points on it."""

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt16
from scipy.spatial import KDTree

from prism_jax.geometry.cloud import sphere
from prism_jax.io.errors import require

DRAWN, KEPT = 150_000, 30_000  # points of all surface, and of what is seen from outside
FEW, FEWER = 10_000, 5000  # the first of them, for all but exact distances
CELLS = 48  # of a grid along the longest side
BESIDE = 0.15  # in longest sides: so much farther does the grid reach
NUM_PAIRED = 300  # points that make pairs
STEPS, ANGLES = 20, 9  # of a pair's length in longest sides, and of its angles in 180
FACING = 0.1  # cosine under which a direction does not say what is seen of a surface
DIRECTIONS = 64
WALL, THINNEST = 24, 0.002  # points around one, and in longest sides
BACK = 0.05  # of the directions that see a point: so many from behind make a sheet
NO_CODE = 2**16 - 1  # of pairs longer than any of the model's


class Front(NamedTuple):
    """Points of a surface that face an eye."""

    points: Float32[np.ndarray, "F 3"]
    normals: Float32[np.ndarray, "F 3"]  # toward it
    tree: Any  # as small_gicp has it
    spacing: float


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """Points of a model's outer surface, from the middle of its box."""

    middle: Float64[np.ndarray, "3"]  # in the model's frame
    points: Float32[np.ndarray, "M 3"]
    normals: Float32[np.ndarray, "M 3"]  # outward
    two_sided: Bool[np.ndarray, " M"]  # seen from both sides, as a sheet is
    # The point nearest to each cell of a grid, whose corner and side these are.
    nearest: UInt16[np.ndarray, "A B C"]
    corner: Float64[np.ndarray, "3"]
    cell: Float64[np.ndarray, ""]
    # Pairs of points in the order of their `pair_codes`.
    codes: UInt16[np.ndarray, " P"]
    pairs: UInt16[np.ndarray, "P 2"]
    widths: Float64[np.ndarray, " D"]  # in many directions, in rising order
    area: Float64[np.ndarray, ""]  # of what is seen

    @property
    def size(self) -> float:
        """The longest side of its box."""
        return float(self.cell * CELLS / (1 + 2 * BESIDE))

    def front(self, eye: Float[np.ndarray, "3"], count: int = KEPT) -> Front:
        """What of so many points faces an eye: all of them, if next to none does."""
        small_gicp = require("small_gicp", "cad")
        points, normals = self.points[:count], self.normals[:count]
        toward = np.einsum("ij,ij->i", eye - points, normals) > 0
        rows = toward | self.two_sided[:count]
        rows = rows if rows.sum() > 100 else np.ones(len(rows), bool)
        normals = np.where(toward[:, None], normals, -normals)[rows]
        spacing, points = float(np.sqrt(self.area / len(points))), points[rows]
        tree = small_gicp.KdTree(small_gicp.PointCloud(points.astype(np.float64)))
        return Front(points, normals, tree, spacing)

    @functools.cached_property
    def cloud(self) -> tuple[Any, Any]:
        """Few points with normals, and their tree, as small_gicp has them."""
        small_gicp = require("small_gicp", "cad")
        cloud = small_gicp.PointCloud(self.points[:FEWER].astype(np.float64))
        tree = small_gicp.KdTree(cloud)
        small_gicp.estimate_normals_covariances(cloud, tree, num_threads=2)
        return cloud, tree

    def index(self, points: Float[np.ndarray, "*shape 3"]) -> Int[np.ndarray, "*shape"]:
        """About the nearest of its points; far outside some point of the edge."""
        cells = (points - self.corner.astype(np.float32)) / np.float32(self.cell)
        top = np.array(self.nearest.shape, np.float32) - 1
        cells = np.clip(cells, 0, top).astype(np.int32)
        _, rows, columns = self.nearest.shape
        flat = (cells[..., 0] * rows + cells[..., 1]) * columns + cells[..., 2]
        return self.nearest.ravel()[flat].astype(np.int32)


def surface_of(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Surface:
    """Of a mesh, whichever way its normals point; the same each time. ValueError where
    nothing of it is seen from outside."""
    trimesh = require("trimesh", "cad")
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.area > 0:
        raise ValueError("it has no surface")
    points, chosen = trimesh.sample.sample_surface(mesh, DRAWN, seed=0)
    middle, turn = mesh.bounds.mean(axis=0), -1 if mesh.volume < 0 else 1
    normals = turn * mesh.face_normals[chosen]
    points = np.asarray(points) - middle
    front, back = _seen(points, normals, np.sqrt(mesh.area / DRAWN))
    seen = np.flatnonzero((front > 0) | (back > 0))
    if len(seen) < 100:
        raise ValueError("nothing of it is seen from outside")
    area = np.asarray(mesh.area * len(seen) / DRAWN)
    seen = seen[:KEPT]
    front, back, points = front[seen], back[seen], points[seen]
    normals, extents = normals[seen], np.ptp(points, axis=0)
    # Of a thin wall each side has some of the other behind it, and is seen through it.
    near = KDTree(points).query(points, k=WALL)[1]
    opposite = np.einsum("ni,nki->nk", normals, normals[near]) < -0.5
    behind = np.einsum("ni,nki->nk", normals, points[near] - points[:, None])
    wall = (opposite & (behind < -THINNEST * extents.max())).any(axis=1)
    two_sided = ~wall & (np.minimum(front, back) > BACK * np.maximum(front, back))
    normals = np.where((wall | (front >= back))[:, None], normals, -normals)
    codes, pairs = _pairs(points[:FEW], normals[:FEW])
    beside = BESIDE * extents.max()
    cell = (extents.max() + 2 * beside) / CELLS
    corner = points.min(axis=0) - beside
    shape = np.ceil((extents + 2 * beside) / cell).astype(int)
    middles = corner + cell * (np.indices(shape).reshape(3, -1).T + 0.5)
    nearest = KDTree(points[:FEW]).query(middles)[1].astype(np.uint16).reshape(shape)
    grid = nearest, corner, np.array(cell)
    single = points.astype(np.float32), normals.astype(np.float32), two_sided
    return Surface(middle, *single, *grid, codes, pairs, widths_of(points[:FEW]), area)


def widths_of(points: Float[np.ndarray, "N 3"], share: float = 0.0) -> np.ndarray:
    """Widths in `DIRECTIONS`, in rising order, without this share at each end. Those of
    a part of something are no larger than those of all of it, rank by rank."""
    along = np.sort(points @ sphere(DIRECTIONS).T, axis=0)
    rank = int(share * len(points))
    return np.sort(along[len(points) - 1 - rank] - along[rank])


def pair_codes(
    points: Float[np.ndarray, "P 2 3"], normals: Float[np.ndarray, "P 2 3"], size: float
) -> UInt16[np.ndarray, " P"]:
    """What of pairs of oriented points no motion changes, in steps: their distance, the
    angles between each normal and the line, and between the normals. After B. Drost et
    al., Model globally, match locally, 2010."""
    line = points[:, 1] - points[:, 0]
    length = np.maximum(np.linalg.norm(line, axis=1), 1e-12)
    line = line / length[:, None]
    code = (length * (STEPS / size)).astype(np.int64)
    first, second = normals.swapaxes(0, 1)
    for one, other in (first, line), (second, line), (first, second):
        cosine = np.clip(np.einsum("ij,ij->i", one, other), -1, 1)
        step = (np.arccos(cosine) * (ANGLES / np.pi)).astype(np.int64)
        code = code * ANGLES + np.minimum(step, ANGLES - 1)
    return np.minimum(code, NO_CODE).astype(np.uint16)


def _pairs(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of some points by their codes."""
    some = spread(points, NUM_PAIRED)
    one, other = np.meshgrid(some, some, indexing="ij")
    pairs = np.stack([one.ravel(), other.ravel()], axis=1)
    size = np.ptp(points, axis=0).max()
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    pairs = pairs[apart > 0.15 * size]
    codes = pair_codes(points[pairs], normals[pairs], size)
    order = np.argsort(codes, kind="stable")
    return codes[order], pairs[order].astype(np.uint16)


def spread(points: Float[np.ndarray, "N 3"], count: int) -> Int[np.ndarray, " count"]:
    """Rows of so many points, or all, each the farthest from those before it."""
    fpsample, count = require("fpsample", "cad"), min(count, len(points))
    rows = fpsample.fps_sampling(points.astype(np.float32), count, start_idx=0)
    return rows.astype(int)


def _seen(
    points: np.ndarray, normals: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """From how many directions points are seen on the side of their normal, and on the
    other."""
    front, back = np.zeros((2, len(points)), int)
    for direction in sphere(DIRECTIONS):
        axes = np.linalg.svd(direction[None])[2][1:]
        seen = foremost(points @ axes.T, -points @ direction, spacing)
        facing = normals @ direction
        front += seen & (facing > FACING)
        back += seen & (facing < -FACING)
    return front, back


def foremost(
    image: Float[np.ndarray, "N 2"], away: Float[np.ndarray, " N"], spacing: float
) -> Bool[np.ndarray, " N"]:
    """Which points of a surface no other ones hide: by how far they are away from a
    viewer, and their places and usual spacing in an image."""
    cells = np.floor((image - image.min(axis=0)) / (2.0 * spacing)).astype(np.int64)
    pixel = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    first = np.full(pixel.max() + 1, np.inf)
    np.minimum.at(first, pixel, away)
    return away <= first[pixel] + 4.0 * spacing
