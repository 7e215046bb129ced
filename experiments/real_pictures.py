"""Pictures of real scans and of what was added to them."""

import itertools
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from experiments.gallery_page import rgb_of
from experiments.real_specs import Done
from experiments.sheets import GREYS, Row, draw_clouds
from prism_jax.completed import CompletedScene
from prism_jax.figures import COMPLETED_COLOR, OBSERVED_COLOR
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.workspace import Workspace
from prism_jax.observation.scene import SUPPORT
from prism_jax.observation.upright import upright
from prism_jax.report.view import viewing_direction

TURN, RISE = 50.0, 25.0
"""Degrees from the sensor's view, so that what was added behind can be seen, and above
level."""

FAR = 8.0
"""How many halves of the longest side the viewer is away."""


def picture_row(label: str, done: Mapping[str, Done], size: int) -> Row:
    """The measured points of a scan, and then its completions, a square picture each.

    Measured points are blue and added ones orange, what belongs to no object of a scene
    is grey. Nearer points hide farther ones. All are seen from one side, near enough
    for objects with all that was added to fill the pictures.
    """
    first, *_ = done.values()
    camera, up = sensor_and_up(first)
    shown = np.concatenate([one.points[of_objects(one)] for one in done.values()])
    frame = Workspace.from_points(shown, 1.0, upright(up))
    seen = frame.camera_to_unit(camera)
    eye = FAR * viewing_direction(seen, turn_degrees=TURN, rise_degrees=RISE)
    outline = jnp.asarray(_extremes(np.asarray(frame.to_unit(shown))))
    view = Camera.framing(outline, eye, 1.1, size, size)
    pictures = [_drawn(first, first.observed, frame, view)]
    for one in done.values():
        pictures.append(_drawn(one, np.ones(len(one.points), bool), frame, view))
    return Row(label, pictures)


def sensor_and_up(done: Done) -> tuple[Camera, np.ndarray]:
    """A view as the sensor had it, and the direction that points upwards."""
    if not isinstance(done, CompletedScene):
        return done.camera, done.workspace.up
    if done.objects:
        return done.objects[0].camera, done.up
    return Camera.look_at(np.zeros(3), done.points.mean(axis=0)), done.up


def of_objects(done: Done) -> Bool[np.ndarray, " M"]:
    """Which points are of an object; all of them, if it is no scene or has none."""
    if isinstance(done, CompletedScene) and done.objects:
        return done.object >= 0
    return np.ones(len(done.points), bool)


def _extremes(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "27 3"]:
    """The farthest points along each axis, diagonal and edge."""
    directions = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    return points[(points @ directions.T).argmax(axis=0)].astype(np.float32)


def _drawn(
    done: Done, which: Bool[np.ndarray, " M"], frame: Workspace, view: Camera
) -> UInt8[np.ndarray, "S S 3"]:
    """Those of the points that are in the picture."""
    points = np.asarray(frame.to_unit(done.points))
    colors = np.where(
        done.observed[:, None], rgb_of(OBSERVED_COLOR), rgb_of(COMPLETED_COLOR)
    )
    colors[~of_objects(done)] = GREYS[SUPPORT]
    which = which & (np.asarray(view.pixel_of(points)[0]) < view.height * view.width)
    return draw_clouds([(points[which], colors[which])], view)
