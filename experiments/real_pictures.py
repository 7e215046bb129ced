"""Pictures of real scans and of what was added to them."""

import itertools
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.gallery_page import rgb_of
from experiments.real_specs import Done
from prism_jax.completed import CompletedScene
from prism_jax.figures import COMPLETED_COLOR, OBSERVED_COLOR
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.workspace import Workspace
from prism_jax.observation.upright import upright
from prism_jax.report.view import viewing_direction
from prism_jax.simulation.contact_sheet import Row, draw_clouds

TURN, RISE = 50.0, 25.0
"""Degrees from the sensor's view, so that what was added behind can be seen, and above
level."""

FAR = 8.0
"""How many halves of the longest side the viewer is away."""


def picture_row(label: str, done: Mapping[str, Done], size: int) -> Row:
    """The measured points of a scan, and then its completions, a square picture each.

    All are seen from one side, and show every added point: none is beside the picture.
    Nearer points hide farther ones, whoever they are of.
    """
    first = next(iter(done.values()))
    measured = first.points[first.observed]
    camera, up = sensor_and_up(first)
    turn = upright(up)
    frame = Workspace.from_points(
        np.concatenate([one.points for one in done.values()]), 1.0, turn
    )
    vertical = np.array([0.0, 0.0, 1.0])
    seen = frame.camera_to_unit(camera)
    toward = viewing_direction(seen, vertical, TURN, RISE)
    shown = {name: frame.to_unit(one.points) for name, one in done.items()}
    view = Camera.framing(jnp.asarray(_box(shown)), FAR * toward, 1.05, size, size)
    colors = np.array([rgb_of(COMPLETED_COLOR), rgb_of(OBSERVED_COLOR)])
    pictures = [draw_clouds([(frame.to_unit(measured), tuple(colors[1]))], view)]
    for name, points in shown.items():
        whose = done[name].observed.astype(int)
        pictures.append(draw_clouds([(points, colors[whose])], view))
    return Row(label, pictures)


def _box(shown: Mapping[str, np.ndarray]) -> Float[np.ndarray, "8 3"]:
    """The corners of the box around all points."""
    everything = np.concatenate(list(shown.values()))
    bounds = zip(everything.min(axis=0), everything.max(axis=0), strict=True)
    return np.array(list(itertools.product(*bounds)), np.float32)


def sensor_and_up(done: Done) -> tuple[Camera, np.ndarray]:
    """A view as the sensor had it, and the direction that points upwards."""
    if not isinstance(done, CompletedScene):
        return done.camera, done.workspace.up
    if done.objects:
        return done.objects[0].camera, done.up
    return Camera.look_at(np.zeros(3), done.points.mean(axis=0)), done.up
