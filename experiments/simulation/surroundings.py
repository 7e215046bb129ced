"""What stands around an object: things in front of it, a floor, a wall behind it.

In the object's frame, z up, its longest side spanning [-1, 1].
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation

from experiments.simulation.raycast import Hits, Scene
from prism_jax.geometry.camera import camera_axes

HIDDEN_SHARES = (0.1, 0.7)  # least and most of the points that an occluder hides
TRIES = 12
NO_PLANES = np.zeros((0, 4))

_BOX = trimesh.creation.box()
_BALL = trimesh.creation.icosphere(2)
_Solid = tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "F 3"]]


class Surroundings(NamedTuple):
    """What a ray may hit beside the object."""

    occluders: Scene | None = None  # things between sensor and object
    # A unit normal and a distance from the origin each; `n x > d` is free.
    planes: Float64[np.ndarray, "P 4"] = NO_PLANES

    def cast(
        self, eye: Float[np.ndarray, "3"], directions: Float[np.ndarray, "R 3"]
    ) -> Hits:
        """The first hit along each ray; planes have the face -1."""
        distances = np.full(len(directions), np.inf)
        cosines, faces = np.zeros(len(directions)), np.full(len(directions), -1)
        lengths = np.linalg.norm(directions, axis=1)
        for *normal, offset in self.planes:
            with np.errstate(divide="ignore", invalid="ignore"):
                slopes = directions @ normal / lengths
                found = (offset - eye @ normal) / slopes
            nearer = (slopes < 0) & (found >= 0) & (found < distances)
            distances[nearer], cosines[nearer] = found[nearer], -slopes[nearer]
        if self.occluders is not None:
            hits = self.occluders.cast(eye, directions)
            nearer = hits.distances < distances[hits.ray]
            ray = hits.ray[nearer]
            distances[ray], cosines[ray] = hits.distances[nearer], hits.cosines[nearer]
            faces[ray] = hits.faces[nearer]
        ray = np.flatnonzero(np.isfinite(distances))
        points = eye + (distances[ray] / lengths[ray])[:, None] * directions[ray]
        return Hits(ray, points, faces[ray], distances[ray], cosines[ray])


def random_planes(
    scene: Scene, eyes: Sequence[Float[np.ndarray, "3"]], rng: np.random.Generator
) -> Float64[np.ndarray, "P 4"]:
    """Nothing, a floor, a wall behind the object, or both.

    The floor is the one the object stands on, or lies deeper; the wall is upright and
    nearly faces the first eye. One that would not have all eyes in front of it is left
    out.
    """
    floor, wall = rng.random(2) < (0.5, 0.4)
    corners, planes = np.asarray(scene.mesh.vertices), []
    if floor:
        gap = rng.choice([0.0, rng.uniform(0.0, 1.5)], p=[0.7, 0.3])
        planes.append((0.0, 0.0, 1.0, corners[:, 2].min() - gap))
    if wall:
        toward = eyes[0] - scene.center
        bearing = np.arctan2(toward[1], toward[0]) + np.radians(rng.uniform(-50, 50))
        normal = np.array([np.cos(bearing), np.sin(bearing), 0.0])
        gap = rng.uniform(0.02, 2.0)
        planes.append((*normal, np.min(corners @ normal) - gap))
    seen = [p for p in planes if all(eye @ p[:3] > p[3] + 0.05 for eye in eyes)]
    return np.array(seen).reshape(-1, 4)


def random_occluder(
    eye: Float[np.ndarray, "3"],
    seen: Float[np.ndarray, "N 3"],
    rng: np.random.Generator,
    other: trimesh.Trimesh | None = None,
) -> Scene | None:
    """Something between an eye and the points in front of it that it would see.

    Bars, boxes, a plate, a blob or, where one is given, another mesh, of any pose. It
    hides between the two `HIDDEN_SHARES` of the points; None if `TRIES` draws do not.
    """
    if not len(seen):
        return None
    axes = camera_axes(seen.mean(axis=0) - eye)
    in_camera = (seen - eye) @ axes.T
    width = np.ptp(in_camera[:, :2] / in_camera[:, 2:], axis=0).max()
    for _ in range(TRIES):
        aim = in_camera[rng.integers(len(seen))]
        depth = rng.uniform(0.35, 0.9) * in_camera[:, 2].min()
        corners, faces = _random_solid(rng, other)
        corners = corners * (rng.uniform(0.3, 1.1) * width * depth)
        corners = (corners + aim * (depth / aim[2])) @ axes + eye
        scene = Scene(trimesh.Trimesh(corners, faces, process=False))
        if HIDDEN_SHARES[0] <= _hidden_share(scene, eye, seen) <= HIDDEN_SHARES[1]:
            return scene
    return None


def _hidden_share(scene: Scene, eye: np.ndarray, seen: np.ndarray) -> float:
    hits = scene.cast(eye, seen - eye)
    nearer = hits.distances < np.linalg.norm(seen - eye, axis=1)[hits.ray]
    return float(nearer.sum() / len(seen))


def _random_solid(rng: np.random.Generator, other: trimesh.Trimesh | None) -> _Solid:
    """A solid around the origin of about unit size, with z away from the eye."""
    makers = [_bars, _boxes, _plate, _blob]
    kind = rng.integers(len(makers) + (other is not None))
    if kind < len(makers):
        return makers[kind](rng)
    assert other is not None
    lower, upper = other.bounds
    corners = (other.vertices - (lower + upper) / 2) / (upper - lower).max()
    # Upright in the camera, y being down, or lying in whatever way.
    turn = Rotation.from_euler("zx", [rng.uniform(0, 360), 90], degrees=True)
    if rng.random() < 0.3:
        turn = _any_turn(rng)
    return turn.apply(corners), np.asarray(other.faces)


def _bars(rng: np.random.Generator) -> _Solid:
    """One to four in parallel, longer than what they stand in front of."""
    thickness = rng.uniform(0.06, 0.3)
    pitch, count = thickness * rng.uniform(2.0, 4.0), rng.integers(1, 5)
    offsets = pitch * (np.arange(count) - (count - 1) / 2)
    scale = np.array([thickness, 12.0, thickness])
    bars = [_BOX.vertices * scale + (offset, 0, 0) for offset in offsets]
    angle = rng.choice([0.0, 90.0, rng.uniform(0, 180)]) + rng.normal(scale=3.0)
    tilt = rng.uniform(-20, 20)
    return _together(bars, Rotation.from_euler("xz", [tilt, angle], degrees=True))


def _boxes(rng: np.random.Generator) -> _Solid:
    """One to three, each turned on its own."""
    boxes = []
    for _ in range(rng.integers(1, 4)):
        box = _BOX.vertices * rng.uniform(0.25, 0.9, 3)
        shift = rng.uniform(-0.5, 0.5, 3)
        boxes.append(_any_turn(rng).apply(box) + shift)
    return _together(boxes, Rotation.identity())


def _plate(rng: np.random.Generator) -> _Solid:
    """Thin, facing the eye more or less."""
    plate = _BOX.vertices * (*rng.uniform(0.4, 1.2, 2), 0.02)
    angles = [rng.uniform(0, 180), *rng.uniform(-50, 50, 2)]
    return _together([plate], Rotation.from_euler("zxy", angles, degrees=True))


def _blob(rng: np.random.Generator) -> _Solid:
    """A ball with bumps, longer one way than another."""
    waves, phases = rng.normal(scale=2.5, size=(3, 3)), rng.uniform(0, 2 * np.pi, 3)
    bumps = np.sin(_BALL.vertices @ waves + phases).mean(axis=1, keepdims=True)
    blob = _BALL.vertices * (1 + 0.6 * bumps) * rng.uniform(0.25, 0.6, 3)
    return _any_turn(rng).apply(blob), _BALL.faces


def _any_turn(rng: np.random.Generator) -> Rotation:
    return Rotation.from_quat(rng.normal(size=4))


def _together(boxes: Sequence[np.ndarray], turn: Rotation) -> _Solid:
    """Boxes as one solid, turned."""
    faces = [_BOX.faces + len(_BOX.vertices) * number for number in range(len(boxes))]
    return turn.apply(np.concatenate(boxes)), np.concatenate(faces)
