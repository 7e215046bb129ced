"""Pictures of simulated frames to look at: is the robot whole, and in its cell?"""

import dataclasses
from collections.abc import Mapping

import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from experiments.simulation.contact_sheet import (
    GROUND_TRUTH,
    OBSERVED,
    Row,
    draw_clouds,
    draw_faces,
    to_bytes,
)
from experiments.simulation.raycast import Scene
from experiments.simulation.roboarm.build import NUM_FRAMES, own_rng
from experiments.simulation.roboarm.cell import look_at
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.roboarm.models import arms_of
from experiments.simulation.roboarm.sequences import (
    RoboArmConfig,
    Sequence,
    make_frame,
    make_sequence,
    scene_parts,
)
from prism_jax.data.recordings import Frame
from prism_jax.geometry.camera import Camera

COLORS = {
    "robot": (0.93, 0.52, 0.15),
    "fixture": (0.25, 0.5, 0.85),
    "support": (0.58, 0.58, 0.6),
    "floor": (0.88, 0.88, 0.86),
    "box": (0.74, 0.63, 0.43),
    "room": (0.88, 0.88, 0.86),
    "clutter": (0.74, 0.63, 0.43),
    "person": (0.55, 0.3, 0.62),
}
_RAMP = np.array([(0.2, 0.1, 0.4), (0.1, 0.5, 0.9), (0.5, 0.9, 0.5), (0.9, 0.3, 0.1)])


def cell_row(split: str, index: int, seed: int, size: int) -> Row:
    """The first frame of a sequence, as `build_roboarm` makes it by default."""
    arms, config = arms_of(split), RoboArmConfig()
    model, rng = arms[index % len(arms)], own_rng(split, seed, index)
    sequence = make_sequence(model, NUM_FRAMES, config, rng)
    frame = make_frame(sequence, 0, config, own_rng(split, seed, index, 0))
    return frame_row(sequence, 0, frame, size)


def frame_row(sequence: Sequence, number: int, frame: Frame, size: int) -> Row:
    """Four square pictures of a frame: the cell from its side, the cell and the depth
    image as the camera has them (cut to a square), and the clouds from the side:
    the partial in blue before the complete one in amber."""
    camera = _square(sequence.cell.camera, size)
    cell = sequence.cell
    beside = beside_camera(cell.camera, cell.lower, cell.upper, size)
    depth = frame.depth.astype(float)
    cut = (depth.shape[1] - depth.shape[0]) // 2
    picks = np.linspace(0, depth.shape[0] - 1, size).astype(int)
    clouds = [(frame.complete, GROUND_TRUTH), (frame.partial, OBSERVED)]
    pictures = (
        draw_scene(sequence, number, beside),
        draw_scene(sequence, number, camera),
        draw_depth(depth[np.ix_(picks, picks + cut)]),
        draw_clouds([cloud for cloud in clouds if cloud[0] is not None], beside),
    )
    hidden = (frame.joints or {}).get("hidden_share", 0.0)
    return Row(f"{sequence.robot.name}, {100 * hidden:.0f} % hidden", pictures)


def draw_scene(
    sequence: Sequence, number: int, camera: Camera
) -> UInt8[np.ndarray, "H W 3"]:
    """A frame's meshes as `draw_parts` draws them."""
    return draw_parts(scene_parts(sequence, number), camera)


def draw_parts(
    parts: Mapping[str, trimesh.Trimesh], camera: Camera
) -> UInt8[np.ndarray, "H W 3"]:
    """Meshes, shaded, with the shadows of one light; `COLORS` by part."""
    palette = np.array([COLORS[part] for part in parts])
    colors = np.repeat(palette, [len(mesh.faces) for mesh in parts.values()], axis=0)
    return draw_faces(Scene(together(list(parts.values()))), colors, camera)


def draw_depth(depth: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Depth as colours, violet near to red far; black where there is no return."""
    seen = depth > 0
    near, far = np.quantile(depth[seen], (0.01, 0.9))
    share = np.clip((depth - near) / (far - near + 1e-9), 0, 1) * (len(_RAMP) - 1)
    low = np.minimum(share.astype(int), len(_RAMP) - 2)
    mix = (share - low)[..., None]
    picture = (1 - mix) * _RAMP[low] + mix * _RAMP[low + 1]
    return to_bytes(np.where(seen[..., None], picture, 0.0))


def beside_camera(
    camera: Camera,
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    size: int,
) -> Camera:
    """A square view of a whole workspace from about 60 degrees beside its camera."""
    center = (lower + upper) / 2
    radius = np.linalg.norm(upper - center)
    toward = np.asarray(camera.position) - center
    azimuth = np.arctan2(toward[1], toward[0]) + 1.0
    direction = np.array([np.cos(azimuth), np.sin(azimuth), 0.6])
    rotation, translation = look_at(center + 2.0 * radius * direction, center)
    camera = _square(camera, size)
    return dataclasses.replace(camera, rotation=rotation, translation=translation)


def _square(camera: Camera, size: int) -> Camera:
    """The middle square of the camera's view, of this many pixels."""
    focal = camera.intrinsics[1, 1] * size / camera.height
    middle = (size - 1) / 2
    intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    return dataclasses.replace(camera, intrinsics=intrinsics, height=size, width=size)
