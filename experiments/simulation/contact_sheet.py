"""Shaded pictures of meshes, and sheets of labelled rows of them.

Pictures are ray cast: an orthographic view, one light with shadows, ambient light where
nothing hides the sky, and a white floor on which only shadows show. A sheet takes rows
of pictures of one size, whatever drew them.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float64, UInt8
from PIL import Image, ImageDraw, ImageFont

from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.raycast import Scene, sphere_directions
from experiments.simulation.shapes import TRAIN_CATEGORIES, make_shape
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.framing import camera_axes

Color = tuple[float, float, float]

STEEL, AMBER = (0.55, 0.66, 0.8), (0.95, 0.68, 0.34)
OBSERVED, GROUND_TRUTH = (0.15, 0.39, 0.69), (0.95, 0.75, 0.5)
TOWARD_VIEWER = (0.8, 1.0, 0.62)
TOWARD_LIGHT = np.array([1.0, 0.1, 1.25]) / np.linalg.norm([1.0, 0.1, 1.25])
TOWARD_SCENE_LIGHT = np.array([0.4, 0.3, 0.85]) / np.linalg.norm([0.4, 0.3, 0.85])
SUPERSAMPLING = 2
SKY_RAYS = 16
SKY_REACH = 0.5
"""Of the diagonal of the mesh's box: what is farther away hides no sky."""
GAMMA = 1.5
MARGIN = 0.06


class Row(NamedTuple):
    """Square pictures of one size under one label."""

    label: str
    pictures: Sequence[UInt8[np.ndarray, "S S 3"]]


def shape_row(category: str, seeds: Sequence[int], size: int) -> Row:
    """The procedural shapes of some seeds; categories never trained on are amber."""
    color = STEEL if category in TRAIN_CATEGORIES else AMBER
    shapes = [make_shape(category, seed) for seed in seeds]
    return Row(category.replace("_", " "), [draw(s, size, color) for s in shapes])


def open_row(seeds: Sequence[int], size: int) -> Row:
    """The open shapes of some seeds that follow one another."""
    label = f"{seeds[0]} to {seeds[-1]}"
    return Row(label, [draw(make_open_shape(seed), size) for seed in seeds])


def draw(
    mesh: trimesh.Trimesh,
    size: int,
    color: Color = STEEL,
    toward_viewer: Color = TOWARD_VIEWER,
) -> UInt8[np.ndarray, "S S 3"]:
    """The mesh on a floor at its lowest point, filling a square picture.

    z is up; `toward_viewer` is a direction in the mesh's frame that leads upwards but
    not straight. `color` is the surface's red, green and blue, each within 0 to 1;
    faces look alike from both sides. A mesh without triangles raises ValueError.
    """
    scene, side = Scene(mesh), size * SUPERSAMPLING
    axes = camera_axes(-np.asarray(toward_viewer, float))
    origins = _pixel_centres(mesh, axes, side)
    hits = scene.cast(origins, np.broadcast_to(axes[2], origins.shape))
    to_floor = (mesh.bounds[0, 2] - origins[:, 2]) / axes[2, 2]
    points = origins + to_floor[:, None] * axes[2]
    normals = np.tile([0.0, 0.0, 1.0], (len(origins), 1))
    seen = scene.normals[hits.faces]
    seen[seen @ axes[2] > 0] *= -1
    points[hits.ray], normals[hits.ray] = hits.points, seen
    points += 1e-4 * scene.radius * normals
    lit, sky = _is_lit(scene, points, normals), _open_sky(scene, points, normals)
    floor = 1 - 0.22 * ~lit - 0.45 * (1 - sky)
    pixels = np.repeat(floor[:, None], 3, axis=1)
    light = np.where(lit, normals @ TOWARD_LIGHT, 0.0)
    pixels[hits.ray] = (0.3 * sky + 0.7 * light)[hits.ray, None] * np.asarray(color)
    image = np.clip(pixels, 0, 1).reshape(size, SUPERSAMPLING, size, SUPERSAMPLING, 3)
    return np.round(255 * image.mean(axis=(1, 3)) ** (1 / GAMMA)).astype(np.uint8)


def draw_clouds(
    clouds: Sequence[tuple[Float[np.ndarray, "_ 3"], Color | Float[np.ndarray, "_ 3"]]],
    camera: Camera,
) -> UInt8[np.ndarray, "H W 3"]:
    """Points of 2 x 2 pixels, later clouds over earlier ones, darker farther away.

    Each cloud has one colour, or one for every point.
    """
    picture = np.ones((camera.height, camera.width, 3))
    for points, color in clouds:
        if not len(points):
            continue
        seen = np.asarray(camera.to_camera(points.astype(float)))
        far_first = np.argsort(-seen[:, 2])
        seen = seen[far_first]
        colors = np.broadcast_to(color, points.shape)[far_first]
        pixels = seen @ np.asarray(camera.intrinsics).T
        columns, rows = np.round(pixels[:, :2] / pixels[:, 2:]).astype(int).T
        nearest = seen[-1, 2]
        shade = 1 - 0.5 * (seen[:, 2] - nearest) / max(np.ptp(seen[:, 2]), 1e-9)
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            row = np.clip(rows + down, 0, camera.height - 1)
            column = np.clip(columns + right, 0, camera.width - 1)
            picture[row, column] = shade[:, None] * colors
    return to_bytes(picture)


def draw_faces(
    scene: Scene, colors: Float[np.ndarray, "F 3"], camera: Camera
) -> UInt8[np.ndarray, "H W 3"]:
    """A scene as a camera sees it, shaded, with the shadows of one light: z is up.

    Each face has a colour; white is where nothing is.
    """
    rows, columns = np.indices((camera.height, camera.width))
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3)
    rays = np.asarray(np.linalg.solve(camera.intrinsics, pixels.T).T @ camera.rotation)
    hits = scene.cast(np.asarray(camera.position), rays)
    normals = scene.normals[hits.faces]
    away = np.sum(normals * rays[hits.ray], axis=1) > 0
    normals[away] *= -1
    lit = np.clip(normals @ TOWARD_SCENE_LIGHT, 0, None)
    shaded = scene.cast(
        hits.points + 1e-3 * normals, np.tile(TOWARD_SCENE_LIGHT, (len(normals), 1))
    )
    lit[shaded.ray] = 0
    light = 0.35 + 0.25 * hits.cosines + 0.4 * lit
    picture = np.ones((len(rays), 3))
    picture[hits.ray] = colors[hits.faces] * light[:, None]
    return to_bytes(picture.reshape(camera.height, camera.width, 3))


def to_bytes(picture: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    """Red, green and blue within 0 to 1 as bytes."""
    return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def contact_sheet(
    rows: Sequence[Row], side_by_side: int = 2, label_height: int = 15
) -> Image.Image:
    """The rows under one another, so many of them side by side, labels above each.

    A row may be shorter than others. No rows at all, or pictures of several sizes,
    raise ValueError.
    """
    sizes = {picture.shape[0] for row in rows for picture in row.pictures}
    if len(sizes) != 1:
        raise ValueError(f"pictures must have one size, got {sorted(sizes)}")
    (size,) = sizes
    across = max(len(row.pictures) for row in rows) * size + size // 8
    down, lines = size + label_height, -(-len(rows) // side_by_side)
    sheet = Image.new("RGB", (across * side_by_side - size // 8, down * lines), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(label_height - 3)
    places = itertools.product(range(lines), range(side_by_side))
    for row, (line, block) in zip(rows, places, strict=False):
        x, y = block * across, line * down
        pen.text((x + 4, y), row.label, "black", font)
        for column, picture in enumerate(row.pictures):
            corner = (x + column * size, y + label_height)
            sheet.paste(Image.fromarray(picture), corner)
    return sheet


def _is_lit(
    scene: Scene, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]
) -> Bool[np.ndarray, " N"]:
    """Whether the surface faces the light and nothing is in between."""
    lit = normals @ TOWARD_LIGHT > 0
    faces_it = np.flatnonzero(lit)
    rays = np.broadcast_to(TOWARD_LIGHT, (len(faces_it), 3))
    lit[faces_it[scene.cast(points[faces_it], rays).ray]] = False
    return lit


def _open_sky(
    scene: Scene, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]
) -> Float64[np.ndarray, " N"]:
    """Share of the half space over each surface, weighted by the cosine, that is free
    of what is near."""
    hidden, reach = np.zeros(len(points)), SKY_REACH * 2 * scene.radius
    for direction in sphere_directions(SKY_RAYS):
        # A point of the unit sphere around the normal's tip: distributed as the cosine.
        hits = scene.cast(points, normals + 0.999 * direction)
        hidden[hits.ray] += np.clip(1 - hits.distances / reach, 0, 1)
    return 1 - hidden / SKY_RAYS


def _pixel_centres(
    mesh: trimesh.Trimesh, axes: Float[np.ndarray, "3 3"], side: int
) -> Float64[np.ndarray, "P 3"]:
    """Ray origins, row by row, in front of the smallest square that shows the mesh."""
    seen = np.asarray(mesh.vertices) @ axes.T
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    middle, half = (lower + upper) / 2, (upper - lower)[:2].max() / 2 * (1 + MARGIN)
    ticks = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(middle[0] + half * ticks, middle[1] + half * ticks)
    depth = np.full(x.size, lower[2] - 0.1 * half)
    return np.stack([x.ravel(), y.ravel(), depth], axis=1) @ axes
