"""One partial view of a mesh: a simulated depth camera, and farthest-point orders.

All points are float64 in the frame of the mesh that is given. Nothing here is
differentiable.
"""

import fpsample
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float64

RAYS = 160 * 160
MAX_RAYS = 16 * RAYS
BUCKET_LEVELS = 5
"""Levels of the search tree of the bucketed farthest-point search: speed only."""


def random_viewpoint(
    rng: np.random.Generator,
    elevation_degrees: tuple[float, float] = (-10.0, 60.0),
    distance: tuple[float, float] = (2.5, 4.0),
) -> Float64[np.ndarray, "3"]:
    """Camera centre around an object that is centred at the origin with its longest
    side spanning [-1, 1]: uniform azimuth, elevation and distance."""
    azimuth = rng.uniform(0.0, 2 * np.pi)
    elevation = np.radians(rng.uniform(*elevation_degrees))
    horizontal = np.cos(elevation)
    direction = (
        horizontal * np.cos(azimuth),
        horizontal * np.sin(azimuth),
        np.sin(elevation),
    )
    return rng.uniform(*distance) * np.array(direction)


def visible_points(
    mesh: trimesh.Trimesh,
    viewpoint: Float[np.ndarray, "3"],
    min_points: int = 2048,
) -> Float64[np.ndarray, "N 3"]:
    """First hits of a regular grid of rays from `viewpoint`, row by row.

    The camera looks at the middle of the mesh, z up, and its grid of square pixels
    is the smallest that holds the projected mesh, like a detector's crop: `RAYS` rays,
    and up to `MAX_RAYS` when a slender object catches fewer than `min_points` of them.
    A viewpoint inside the mesh's bounding sphere raises ValueError.
    """
    center = mesh.bounds.mean(axis=0)
    if np.linalg.norm(viewpoint - center) <= np.linalg.norm(mesh.extents) / 2:
        raise ValueError("viewpoint lies inside the mesh's bounding sphere")
    axes = _camera_axes(center - viewpoint)
    triangles = np.asarray(mesh.triangles)
    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))
    in_camera = (np.asarray(mesh.vertices) - viewpoint) @ axes.T
    tangents = in_camera[:, :2] / in_camera[:, 2:]

    points = _cast(scene, triangles, viewpoint, _grid(tangents, RAYS) @ axes)
    if len(points) < min_points:
        rays = int(RAYS * 1.2 * min_points / max(len(points), 1))
        rays = min(rays, MAX_RAYS)
        points = _cast(scene, triangles, viewpoint, _grid(tangents, rays) @ axes)
    return points


def farthest_point_order(
    points: Float[np.ndarray, "N 3"], num_points: int
) -> Float[np.ndarray, "M 3"]:
    """The first `num_points` points in exact farthest-point order.

    Every prefix of the result is a farthest-point sample. Where `points` has fewer
    rows, the order is repeated cyclically. An empty cloud raises ValueError.
    The bucket search visits the points in its own order, so the first one is an
    arbitrary yet fixed function of the cloud.
    """
    if len(points) == 0:
        raise ValueError("cannot sample an empty cloud")
    distinct = min(num_points, len(points))
    coordinates = np.ascontiguousarray(points, np.float32)
    if len(points) < 1 << BUCKET_LEVELS:
        order = fpsample.fps_sampling(coordinates, distinct, start_idx=0)
    else:
        order = fpsample.bucket_fps_kdline_sampling(
            coordinates, distinct, h=BUCKET_LEVELS, start_idx=0
        )
    return points[np.resize(order.astype(np.int64), num_points)]


def _camera_axes(forward: np.ndarray) -> np.ndarray:
    """Rows: right, down and forward of an OpenCV camera with z up in the world."""
    forward = forward / np.linalg.norm(forward)
    up = (0.0, 0.0, 1.0) if abs(forward[2]) < 0.999 else (0.0, 1.0, 0.0)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _grid(tangents: np.ndarray, rays: int) -> np.ndarray:
    """About `rays` directions (x, y, 1) at the pixel centres of the tangents' box."""
    lower, upper = tangents.min(axis=0), tangents.max(axis=0)
    pitch = np.sqrt(np.prod(upper - lower) / rays)
    columns, rows = (
        np.arange(low + pitch / 2, high, pitch)
        for low, high in zip(lower, upper, strict=True)
    )
    x, y = np.meshgrid(columns, rows)
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)


def _cast(
    scene: EmbreeScene,
    triangles: np.ndarray,
    origin: np.ndarray,
    directions: np.ndarray,
) -> np.ndarray:
    origins = np.broadcast_to(origin.astype(np.float32), directions.shape)
    result = scene.run(
        np.ascontiguousarray(origins), directions.astype(np.float32), output=True
    )
    hit = result["primID"] >= 0
    corners = triangles[result["primID"][hit]]
    u, v = (result[name][hit, None].astype(np.float64) for name in ("u", "v"))
    return (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
