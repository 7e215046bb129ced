"""Shaded pictures of meshes, and sheets of labelled rows of them.

A picture is cast with our own rays: an orthographic view, one light with shadows, the
sky as far as it is not occluded, and a floor that only shows what falls on it. A sheet
takes rows of any pictures of one size, whatever drew them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float64, UInt8
from PIL import Image, ImageDraw, ImageFont

STEEL, AMBER = (0.56, 0.66, 0.78), (0.93, 0.68, 0.36)
FRONT_RIGHT_ABOVE = (0.8, 1.0, 0.62)
_TO_LIGHT = np.array([0.9, 0.25, 1.25]) / np.linalg.norm([0.9, 0.25, 1.25])
_SUPERSAMPLING = 2
_SKY_RAYS = 16
_MARGIN = 0.06


class Row(NamedTuple):
    """Square pictures of one size with the label that stands above them."""

    label: str
    pictures: Sequence[UInt8[np.ndarray, "S S 3"]]


def draw_mesh(
    mesh: trimesh.Trimesh,
    size: int,
    color: tuple[float, float, float] = STEEL,
    toward_viewer: tuple[float, float, float] = FRONT_RIGHT_ABOVE,
) -> UInt8[np.ndarray, "S S 3"]:
    """The mesh on a white floor at its lowest point, filling a square picture.

    Orthographic, z up; `toward_viewer` is a direction in the mesh's frame and must not
    be vertical. `color` is the surface's, of red, green and blue within 0 to 1.
    """
    caster = _Caster(mesh)
    axes = _view_axes(np.asarray(toward_viewer))
    points = _pixel_centres(mesh, axes, size * _SUPERSAMPLING)
    forward = axes[2]
    hit, distance, normals = caster.first_hits(points, forward)
    where = points + distance[:, None] * forward
    floor = mesh.bounds[0, 2]
    on_floor = ~hit
    reach = (floor - points[on_floor, 2]) / forward[2]
    where[on_floor] = points[on_floor] + reach[:, None] * forward
    normals[on_floor] = (0.0, 0.0, 1.0)
    radius = mesh.scale
    light, sky = caster.light_and_sky(where + 1e-4 * radius * normals, normals, radius)
    shade = np.where(hit, 0.30 * sky + 0.70 * light, 0.0)
    pixels = shade[:, None] * np.asarray(color)
    blocked = 0.45 * (1 - sky) + 0.22 * (light <= 0)
    pixels[on_floor] = (1 - blocked[on_floor])[:, None]
    side = size * _SUPERSAMPLING
    image = np.clip(pixels, 0, 1).reshape(side, side, 3) ** (1 / 1.5)
    image = image.reshape(size, _SUPERSAMPLING, size, _SUPERSAMPLING, 3).mean((1, 3))
    return np.round(255 * image).astype(np.uint8)


class _Caster:
    """Rays from points outside of a mesh."""

    def __init__(self, mesh: trimesh.Trimesh):
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, np.asarray(mesh.triangles, np.float32))
        self._normals = np.asarray(mesh.face_normals)

    def first_hits(self, origins: np.ndarray, directions: np.ndarray):
        """What is hit, how far away, and the surface's normal there."""
        directions = np.broadcast_to(directions, origins.shape).astype(np.float32)
        result = self._scene.run(
            np.ascontiguousarray(origins, np.float32), directions, output=True
        )
        hit = result["primID"] >= 0
        normals = self._normals[np.where(hit, result["primID"], 0)]
        return hit, result["tfar"].astype(float), normals.copy()

    def light_and_sky(
        self, points: np.ndarray, normals: np.ndarray, radius: float
    ) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
        """The light's cosine, zero in shadow, and the free share of the sky that the
        surface faces."""
        cosine = np.clip(normals @ _TO_LIGHT, 0, None)
        lit = cosine > 0
        lit[lit] = ~self.first_hits(points[lit], _TO_LIGHT)[0]
        free = np.zeros(len(points))
        for direction in _sphere(_SKY_RAYS):
            # Unit normal plus a point of the unit sphere: distributed as the cosine.
            ray = normals + 0.999 * direction
            hit, distance, _ = self.first_hits(points, ray)
            gap = distance * np.linalg.norm(ray, axis=1) / (0.5 * radius)
            free += np.where(hit, np.clip(gap, 0, 1), 1.0)
        return cosine * lit, free / _SKY_RAYS


def contact_sheet(
    rows: Sequence[Row], rows_side_by_side: int = 2, label_height: int = 15
) -> Image.Image:
    """The rows under one another, so many of them side by side, labels above."""
    size = rows[0].pictures[0].shape[0]
    columns = max(len(row.pictures) for row in rows)
    gap = size // 8
    wide, tall = columns * size + gap, size + label_height
    lines = -(-len(rows) // rows_side_by_side)
    sheet = Image.new("RGB", (wide * rows_side_by_side - gap, tall * lines), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(label_height - 3)
    for index, row in enumerate(rows):
        line, block = divmod(index, rows_side_by_side)
        x, y = block * wide, line * tall
        for column, picture in enumerate(row.pictures):
            tile = Image.fromarray(picture)
            sheet.paste(tile, (x + column * size, y + label_height))
        draw.text((x + 4, y), row.label, "black", font)
    return sheet


def _view_axes(toward_viewer: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    """Rows: right, down and forward."""
    forward = -toward_viewer / np.linalg.norm(toward_viewer)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _pixel_centres(
    mesh: trimesh.Trimesh, axes: Float[np.ndarray, "3 3"], side: int
) -> Float64[np.ndarray, "P 3"]:
    """Ray origins, row by row, in front of the smallest square that shows the mesh."""
    seen = np.asarray(mesh.vertices) @ axes.T
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    middle, half = (lower + upper) / 2, (upper - lower)[:2].max() / 2 * (1 + _MARGIN)
    ticks = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(middle[0] + half * ticks, middle[1] + half * ticks)
    depth = np.full(x.size, lower[2] - 0.1 * half)
    return np.stack([x.ravel(), y.ravel(), depth], axis=1) @ axes


def _sphere(count: int) -> Float64[np.ndarray, "N 3"]:
    """Evenly spread points of the unit sphere: a Fibonacci lattice."""
    step = np.arange(count) + 0.5
    height, turn = 1 - 2 * step / count, np.pi * (1 + 5**0.5) * step
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
