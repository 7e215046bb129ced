"""Frames of the varied cells: what a depth camera measures and knows, and the truth."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from experiments.simulation.raycast import Scene, sample_outside
from experiments.simulation.readings import Readings, map_of
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.roboarm.sequences import flying_pixels
from experiments.simulation.roboarm.workcells import Workcell, scene_of
from experiments.simulation.sensors import L515Config, l515_depth, pixel_rays
from experiments.simulation.truncation import NO_CUT, random_cut
from experiments.simulation.views import PARTIAL_POINTS, SURFACE_POINTS
from prism_jax.data.ordering import farthest_point_order
from prism_jax.data.recordings import DEPTH_SCALE, LABELS
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import (
    BACKGROUND,
    NEARER,
    SURFACE,
    UNKNOWN,
    Visibility,
    framing_camera,
)
from prism_jax.preprocessing.visibility_map import box_exit

KINDS = ("robot", "fixture", "clutter", "clutter", "clutter", "person")  # of `PARTS`
OPEN_PARTS = ("robot", "fixture", "support", "room")
"""What stands there when the truth is surveyed: no clutter, nobody."""
FEW = 4000  # rays by which shares of an image are estimated
MIN_POINTS, MIN_IMAGE, MIN_SHARE = 64, 0.003, 0.05
"""A frame shows at least so many points of robot and fixtures, on so much of the image,
and so much of what the camera would see of them if nothing were in the way."""
CELL_MARGIN, FLOOR_MARGIN = 0.1, 0.03
"""Metres that the workspace is larger than robot and fixtures, and that it keeps off
what they stand on."""
RAYS_A_PIXEL = 5
"""Of the depth image, for each pixel of a map: with more, one lost return among many
would make it unknown."""


class CellView(NamedTuple):
    """A frame of a varied cell; metres, the cell's frame."""

    partial: Float32[np.ndarray, "N 3"]  # of robot and fixtures, farthest first
    complete: Float32[np.ndarray, "M 3"]
    eye: Float32[np.ndarray, "3"]
    visibility: Visibility
    cut: bool  # whether more than the image's own edges cuts the partial cloud off
    depth: UInt16[np.ndarray, "H W"]  # counts of `DEPTH_SCALE`
    labels: UInt8[np.ndarray, "H W"]
    camera: Camera


def make_cell_view(
    cell: Workcell,
    number: int,
    rng: np.random.Generator,
    sensor: L515Config = L515Config(),
    truncated_share: float = 0.2,
    num_partial: int = PARTIAL_POINTS,
    num_complete: int = SURFACE_POINTS,
) -> CellView:
    """Frame `number` of a cell; ValueError where next to nothing of it is seen."""
    parts = cell.parts(number)
    scene, sizes = scene_of(parts)
    face_labels = np.repeat(np.array([LABELS[kind] for kind in KINDS], np.uint8), sizes)
    shiny = _glossy_faces(cell, sizes)
    counts, faces = l515_depth(scene, cell.camera, rng, sensor, shiny)
    labels = np.where(faces < 0, np.uint8(LABELS["nothing"]), face_labels[faces])
    rays, depth = pixel_rays(cell.camera), (counts * DEPTH_SCALE).reshape(-1)
    eye = np.asarray(cell.camera.position)
    measured = _measured(depth, labels, rays, cell)

    bare, sizes = scene_of({name: parts[name] for name in OPEN_PARTS})
    whole = _hit_share(bare, sum(sizes[:2]), eye, rays)
    least = max(MIN_POINTS, max(MIN_IMAGE, MIN_SHARE * whole) * len(rays))
    if np.count_nonzero(measured) < least:
        raise ValueError("the camera sees next to nothing of robot and fixtures")
    points = eye + depth[measured, None] * rays[measured]
    seen = Readings(np.full(len(points), SURFACE, np.uint8), points, 0.0)
    is_cut, cut = bool(rng.random() < truncated_share), NO_CUT
    if is_cut:
        own = Scene(together([parts["robot"], parts["fixture"]]))
        cut = random_cut(own, eye, points, rng)
    seen = cut.apply(seen, eye).surface
    if len(seen.points) < MIN_POINTS:
        raise ValueError("next to nothing is left of what the camera sees")
    around = framing_camera(seen.points, eye)
    few = _thinned(counts.shape, cell.camera, around)
    known = _readings(
        depth[few], measured[few], labels.reshape(-1)[few], rays[few], cell
    )
    return CellView(
        farthest_point_order(seen.points, num_partial).astype(np.float32),
        _complete(bare, sum(sizes[:2]), num_complete, rng).astype(np.float32),
        eye.astype(np.float32),
        map_of(around, [cut.apply(known, eye), seen]),
        is_cut,
        counts,
        labels,
        cell.camera,
    )


def _hit_share(
    scene: Scene, wanted_faces: int, eye: np.ndarray, rays: np.ndarray
) -> float:
    """Of the rays, estimated by a few, those that hit one of the first faces."""
    few = rays[:: max(1, len(rays) // FEW)]
    return float(np.count_nonzero(scene.cast(eye, few).faces < wanted_faces) / len(few))


def _glossy_faces(cell: Workcell, sizes: list[int]) -> np.ndarray:
    shiny, links = np.zeros(sum(sizes), bool), cell.arm.robot.faces_link
    shiny[: len(links)] = cell.glossy[links]
    shiny[len(links) : sizes[0]] = cell.glossy[-2]
    shiny[sizes[0] : sizes[0] + sizes[1]] = cell.glossy[-1]
    return shiny


def _measured(
    depth: np.ndarray, labels: np.ndarray, rays: np.ndarray, cell: Workcell
) -> np.ndarray:
    """Pixels that measured robot or fixtures within the workspace, without those that
    lie between two surfaces."""
    wanted = np.isin(labels, (LABELS["robot"], LABELS["fixture"])).reshape(-1)
    measured = (
        wanted & (depth > 0) & ~flying_pixels(depth.reshape(labels.shape)).ravel()
    )
    points = np.asarray(cell.camera.position) + depth[measured, None] * rays[measured]
    lower, upper = cell.lower - CELL_MARGIN, cell.upper + CELL_MARGIN
    measured[measured] = np.all((points > lower) & (points < upper), axis=1)
    return measured


def _readings(
    depth: np.ndarray,
    measured: np.ndarray,
    labels: np.ndarray,
    rays: np.ndarray,
    cell: Workcell,
) -> Readings:
    """What some pixels know. Neither robot nor fixture hides what is behind it where
    the workspace goes on there, and is background where it does not."""
    eye = np.asarray(cell.camera.position)
    lower, upper = cell.lower - CELL_MARGIN, cell.upper + CELL_MARGIN
    lower[2] = cell.lower[2] + FLOOR_MARGIN
    hides = box_exit(eye, rays, lower, upper) > depth + FLOOR_MARGIN
    state = np.where(hides, NEARER, BACKGROUND).astype(np.uint8)
    own = np.isin(labels, (LABELS["robot"], LABELS["fixture"]))
    state[measured] = SURFACE
    state[(own & ~measured) | (depth == 0)] = UNKNOWN
    return Readings(state, eye + np.where(depth > 0, depth, 1.0)[:, None] * rays, 0.0)


def _thinned(shape: tuple[int, int], camera: Camera, around: Camera) -> np.ndarray:
    """Evenly spaced pixels of an image, about `RAYS_A_PIXEL` for each pixel of a map
    that sees more closely."""
    ratio = camera.intrinsics[0, 0] / around.intrinsics[0, 0]
    step = max(1, int(ratio / np.sqrt(RAYS_A_PIXEL)))
    return np.arange(shape[0] * shape[1]).reshape(shape)[::step, ::step].reshape(-1)


def _complete(
    scene: Scene, wanted_faces: int, num_points: int, rng: np.random.Generator
) -> np.ndarray:
    """Robot and fixtures, which are the first faces, as far as they are seen from
    outside."""
    wanted = np.arange(len(scene.areas)) < wanted_faces
    surface = sample_outside(scene, num_points, rng, two_sided=True, wanted=wanted)
    return farthest_point_order(surface, num_points)
