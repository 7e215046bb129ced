"""Pictures of partial views: what was measured, and what the sensor knows."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from experiments.simulation.contact_sheet import (
    GROUND_TRUTH,
    OBSERVED,
    Row,
    draw_clouds,
    to_bytes,
)
from experiments.simulation.views import make_views
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import (
    BACKGROUND,
    NEARER,
    SURFACE,
    UNKNOWN,
    Visibility,
)

COLORS = {
    UNKNOWN: (0.82, 0.82, 0.82),
    SURFACE: OBSERVED,
    NEARER: (0.80, 0.25, 0.20),
    BACKGROUND: (0.68, 0.87, 0.66),
}
ASIDE, DISTANCE = 40.0, 4.5
"""Degrees beside the sensor that clouds are drawn from, and how far off."""


def kind_row(kind: str, categories: Sequence[str], seed: int, size: int) -> Row:
    """Shapes of these categories, seen once in a kind that has maps.

    Two pictures each: the partial in blue over the complete cloud in amber, from beside
    the sensor; and the map, grey where nothing is known, blue where the object was
    measured, red where something nearer was, and green where the sensor looked past.
    """
    pictures = []
    for category in categories:
        made = make_views(category, seed, 1, kind)
        (partial,), (eye,), (visibility,) = made.partials, made.eyes, made.visibilities
        if visibility is None:
            raise ValueError(f"views of the kind {kind!r} have no map")
        clouds = [(made.complete, GROUND_TRUTH), (partial, OBSERVED)]
        pictures.append(draw_clouds(clouds, _beside(eye, size)))
        pictures.append(draw_map(visibility, size))
    return Row(kind.replace("+", ", "), pictures)


def draw_map(visibility: Visibility, size: int) -> UInt8[np.ndarray, "S S 3"]:
    """The states of a map in four colours, with a margin of one pixel."""
    palette = np.array([COLORS[state] for state in sorted(COLORS)])
    image = Image.fromarray(to_bytes(palette[visibility.state]))
    picture = np.full((size, size, 3), 255, np.uint8)
    inner = image.resize((size - 2, size - 2), Image.Resampling.NEAREST)
    picture[1:-1, 1:-1] = np.asarray(inner)
    return picture


def _beside(eye: np.ndarray, size: int) -> Camera:
    toward = Rotation.from_euler("z", ASIDE, degrees=True).apply(eye)
    toward = toward / np.linalg.norm(toward) * DISTANCE
    return Camera.look_at(toward, (0, 0, 0), fov_degrees=34.0, height=size, width=size)
