"""Pictures of clouds, and sheets of labelled rows of pictures."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from prism_jax.geometry.camera import Camera
from prism_jax.preprocessing.segmentation.scene import LEFT_OVER, SUPPORT

Color = tuple[float, float, float]
GREYS: dict[int, Color] = {SUPPORT: (0.8, 0.8, 0.8), LEFT_OVER: (0.35, 0.35, 0.35)}


class Row(NamedTuple):
    """Square pictures of one size under one label."""

    label: str
    pictures: Sequence[UInt8[np.ndarray, "S S 3"]]


def draw_clouds(
    clouds: Sequence[tuple[Float[np.ndarray, "_ 3"], Color | Float[np.ndarray, "_ 3"]]],
    camera: Camera,
) -> UInt8[np.ndarray, "H W 3"]:
    """Points of 2 x 2 pixels, later clouds over earlier ones, darker farther away.
    Each cloud has one colour, or one for every point."""
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
        shade = 1 - 0.5 * (seen[:, 2] - seen[-1, 2]) / max(np.ptp(seen[:, 2]), 1e-9)
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            row = np.clip(rows + down, 0, camera.height - 1)
            column = np.clip(columns + right, 0, camera.width - 1)
            picture[row, column] = shade[:, None] * colors
    return to_bytes(picture)


def to_bytes(picture: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    """Red, green and blue within 0 to 1 as bytes."""
    return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def contact_sheet(
    rows: Sequence[Row], side_by_side: int = 2, label_height: int = 15
) -> Image.Image:
    """The rows under one another, so many of them side by side, labels above each.
    No rows at all, or pictures of several sizes, raise ValueError."""
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
            sheet.paste(Image.fromarray(picture), (x + column * size, y + label_height))
    return sheet
