"""What a sensor measures of a mesh from one viewpoint, in the frame of the mesh."""

import numpy as np
import trimesh
from jaxtyping import Float, Float64

from experiments.simulation.raycast import Scene, direction
from experiments.simulation.readings import RAYS, pixel_grid
from experiments.simulation.sensors import (
    L515Config,
    OusterConfig,
    cropped_to,
    l515_camera,
    l515_depth,
    ouster_scan,
)
from prism_jax.data.crops import random_crop
from prism_jax.geometry.camera import camera_axes
from prism_jax.io.depth import points_from_depth

PARTIALS = ("self_occlusion", "crop", "l515", "ouster", "sparse")
"""Kinds of partial clouds that `make_partial` knows."""

MAX_RAYS = 16 * RAYS
HALF_EXTENT = 0.6
"""Metres that the unit of length stands for where a sensor's own scale matters: an
object whose longest side spans [-1, 1] is 1.2 m long."""
SPARSE_RETURNS = 256


def make_partial(
    kind: str,
    scene: Scene,
    complete: Float[np.ndarray, "M 3"],
    rng: np.random.Generator,
    num_points: int,
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "3"]]:
    """One of `PARTIALS` from a random viewpoint: the points as measured, and viewpoint.

    The mesh's box is centred at the origin and its longest side spans [-1, 1];
    `complete` is a cloud of it. The cloud is not resampled: it has as many points as
    the sensor measured, perhaps none, where `self_occlusion` aims at no fewer than
    `num_points`. `crop` takes a random direction, as its published training does, and
    removes a random share from the easiest to the hardest.
    """
    if kind not in PARTIALS:
        raise ValueError(f"unknown partial {kind!r}: choose one of {PARTIALS}")
    if kind == "crop":
        return random_crop(np.asarray(complete, np.float64), rng)
    viewpoint = random_viewpoint(rng)
    if kind == "self_occlusion":
        return self_occlusion(scene, viewpoint, num_points), viewpoint
    if kind == "sparse":
        return sparse(scene, viewpoint, rng), viewpoint
    return (l515 if kind == "l515" else ouster)(scene, viewpoint, rng), viewpoint


def random_viewpoint(
    rng: np.random.Generator,
    elevation_degrees: tuple[float, float] = (-10.0, 60.0),
    distance: tuple[float, float] = (2.5, 4.0),
) -> Float64[np.ndarray, "3"]:
    """Camera centre around an object that is centred at the origin with its longest
    side spanning [-1, 1]: uniform azimuth, elevation and distance."""
    azimuth = rng.uniform(0.0, 2 * np.pi)
    elevation = np.radians(rng.uniform(*elevation_degrees))
    return rng.uniform(*distance) * direction(azimuth, elevation)


def self_occlusion(
    scene: Scene, viewpoint: Float[np.ndarray, "3"], min_points: int = 2048
) -> Float64[np.ndarray, "N 3"]:
    """First hits of a regular grid of rays from `viewpoint`, row by row, exactly.

    The grid of square pixels is the smallest that holds the projected mesh, like a
    detector's crop: `RAYS` rays, and up to `MAX_RAYS` when a slender object catches
    fewer than `min_points` of them. A viewpoint inside the mesh's bounding sphere
    raises ValueError.
    """
    axes = _axes_outside(scene, viewpoint)
    in_camera = (np.asarray(scene.mesh.vertices) - viewpoint) @ axes.T
    tangents = in_camera[:, :2] / in_camera[:, 2:]

    points = scene.cast(viewpoint, _grid(tangents, RAYS) @ axes).points
    if len(points) < min_points:
        rays = int(RAYS * 1.2 * min_points / max(len(points), 1))
        rays = min(rays, MAX_RAYS)
        points = scene.cast(viewpoint, _grid(tangents, rays) @ axes).points
    return points


def sparse(
    scene: Scene,
    viewpoint: Float[np.ndarray, "3"],
    rng: np.random.Generator,
    num_returns: int = SPARSE_RETURNS,
) -> Float64[np.ndarray, "N 3"]:
    """A random `num_returns` of the points of `self_occlusion`, or all if fewer."""
    points = self_occlusion(scene, viewpoint)
    count = min(num_returns, len(points))
    return points[np.sort(rng.choice(len(points), count, replace=False))]


def l515(
    scene: Scene,
    viewpoint: Float[np.ndarray, "3"],
    rng: np.random.Generator,
    config: L515Config = L515Config(),
) -> Float64[np.ndarray, "N 3"]:
    """What an L515 at `viewpoint` measures of the object, its longest side 1.2 m, of
    the part of the image that holds it; in the mesh's frame, row by row."""
    camera = l515_camera(_axes_outside(scene, viewpoint), viewpoint * HALF_EXTENT)
    metric = _in_metres(scene)
    camera = cropped_to(camera, np.asarray(metric.mesh.vertices))
    counts, _ = l515_depth(metric, camera, rng, config)
    return points_from_depth(counts * config.quantum, counts > 0, camera) / HALF_EXTENT


def ouster(
    scene: Scene,
    viewpoint: Float[np.ndarray, "3"],
    rng: np.random.Generator,
    config: OusterConfig = OusterConfig(),
) -> Float64[np.ndarray, "N 3"]:
    """What an Ouster at `viewpoint` measures of the object, its longest side 1.2 m, in
    the mesh's frame. Its middle beam at column 0 aims at the object's centre."""
    right, down, forward = _axes_outside(scene, viewpoint)
    rotation = np.stack([forward, -right, -down], axis=1)
    position = viewpoint * HALF_EXTENT
    returns = ouster_scan(_in_metres(scene), position, rng, config, rotation)
    return returns.points / HALF_EXTENT


def _axes_outside(scene: Scene, viewpoint: np.ndarray) -> np.ndarray:
    """Axes of a camera at a viewpoint outside the mesh that looks at its middle."""
    if np.linalg.norm(viewpoint - scene.center) <= scene.radius:
        raise ValueError("viewpoint lies inside the mesh's bounding sphere")
    return camera_axes(scene.center - viewpoint)


def _in_metres(scene: Scene) -> Scene:
    vertices = np.asarray(scene.mesh.vertices) * HALF_EXTENT
    return Scene(trimesh.Trimesh(vertices, scene.mesh.faces, process=False))


def _grid(tangents: np.ndarray, rays: int) -> np.ndarray:
    """About `rays` directions (x, y, 1) at the pixel centres of the tangents' box."""
    pitch = np.sqrt(np.prod(np.ptp(tangents, axis=0)) / rays)
    return pixel_grid(tangents, pitch).reshape(-1, 3)
