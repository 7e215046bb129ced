"""Pictures of scenes to look at: does everything stand, and apart from the rest?"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from experiments.simulation.contact_sheet import Color, Row, draw_clouds, draw_faces
from experiments.simulation.raycast import Scene
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.scenes.build import (
    MadeScene,
    ScenesConfig,
    make_scene,
)
from experiments.simulation.scenes.things import Pools
from prism_jax.geometry.camera import Camera
from prism_jax.observation.scene import LEFT_OVER, SUPPORT

COLORS: tuple[Color, ...] = (
    (0.12, 0.47, 0.71),
    (1.00, 0.50, 0.05),
    (0.17, 0.63, 0.17),
    (0.84, 0.15, 0.16),
    (0.58, 0.40, 0.74),
    (0.55, 0.34, 0.29),
    (0.89, 0.47, 0.76),
    (0.74, 0.74, 0.13),
)
"""Of things, by number."""
GREYS: dict[int, Color] = {SUPPORT: (0.8, 0.8, 0.8), LEFT_OVER: (0.35, 0.35, 0.35)}

ASIDE, RAISED = 35.0, 12.0
"""Degrees beside the sensor, and above it, that scenes are drawn from."""
FIELD, FILLED = 36.0, 1.1
"""Degrees of a picture's view, and how much farther off it is than to show just all
things."""


def scene_row(config: ScenesConfig, pools: Pools, index: int, size: int) -> Row:
    """Two square pictures of a scene from beside its sensor: the meshes, and what was
    measured; things in colours, what they stand on light grey, the rest dark."""
    made = make_scene(config, pools, index)
    camera = _beside(made, size)
    label = ", ".join([f"{len(made.things)} things", *made.traits])
    return Row(label, (_meshes(made, camera), _points(made, camera)))


def _meshes(made: MadeScene, camera: Camera) -> np.ndarray:
    meshes = [thing.mesh for thing in made.things] + [part.mesh for part in made.parts]
    labels = [*range(len(made.things)), *(part.label for part in made.parts)]
    faces = np.repeat(labels, [len(mesh.faces) for mesh in meshes])
    return draw_faces(Scene(together(meshes)), _colors(faces), camera)


def _points(made: MadeScene, camera: Camera) -> np.ndarray:
    points, labels = made.measured
    pixel, _ = camera.pixel_of(points)
    seen = np.asarray(pixel) < camera.height * camera.width
    return draw_clouds([(points[seen], _colors(labels[seen]))], camera)


def _colors(labels: np.ndarray) -> Float[np.ndarray, "N 3"]:
    palette = np.array([GREYS[LEFT_OVER], GREYS[SUPPORT], *COLORS])
    return palette[labels - LEFT_OVER]


def _beside(made: MadeScene, size: int) -> Camera:
    bounds = np.array([thing.mesh.bounds for thing in made.things])
    lower, upper = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    center, radius = (lower + upper) / 2, np.linalg.norm(upper - lower) / 2
    toward = made.sensor.rays.eye - center
    azimuth = np.arctan2(toward[1], toward[0])
    tilt = np.arcsin(toward[2] / np.linalg.norm(toward)) + np.radians(RAISED)
    level = Rotation.from_euler("z", azimuth + np.radians(ASIDE)).apply([1.0, 0, 0])
    toward = np.cos(tilt) * level + (0.0, 0.0, np.sin(tilt))
    distance = FILLED * radius / np.sin(np.radians(FIELD / 2))
    return Camera.look_at(
        center + distance * toward, center, fov_degrees=FIELD, height=size, width=size
    )
