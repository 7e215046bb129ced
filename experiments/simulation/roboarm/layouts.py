"""Where things find room in a robot cell, around what an arm does in it.

World frame: metres, z up, floor at z = 0; an arm's first place is above the origin.
"""

import numpy as np
import trimesh
from jaxtyping import Float64
from manifold3d import Manifold

from experiments.simulation.raycast import direction
from experiments.simulation.roboarm.cell import are_hidden
from experiments.simulation.roboarm.furnishings import (
    FIXTURES,
    fence,
    fixture,
    random_person,
    to_mesh,
    together,
    upright,
)
from experiments.simulation.roboarm.mounts import Mount
from experiments.simulation.sensors import l515_camera
from experiments.simulation.solids import Rng, Solids, box
from prism_jax.geometry.camera import Camera, camera_axes

PERSON_SHARES = (0.45, 0.35, 0.2)  # how often nobody, one and two stand in a cell
HIDDEN = 0.7  # most of the arm that clutter and people hide from the camera
DISTANCES = (0.6, 1.25)  # from camera to middle, in units of what shows the whole
NEAREST, FARTHEST = 0.6, 7.5
ROOM = 7.0  # half of the floor's side
Top = tuple[np.ndarray, np.ndarray, float]  # corners (x, y) and height of a table
_TRIES = 30
_HALF_FIELD = np.radians(27.5)


class Layout:
    """What stands where in a cell, by bounding boxes."""

    def __init__(self, sweep: Float64[np.ndarray, "N 3"], reach: float):
        # Points on the arm in all of its poses, and metres that it reaches.
        self.sweep, self.reach = sweep, reach
        self.gap = 0.03 + 0.02 * reach
        self._boxes: list[np.ndarray] = []

    def add(self, solids: Solids) -> None:
        """Keeps others off what solids' boxes hold."""
        self._boxes += [np.array(solid.bounding_box()) for solid in solids]

    def is_clear(self, solids: Solids, gap: float | None = None) -> bool:
        """Whether solids keep off the arm, and off all that was added."""
        gap = self.gap if gap is None else gap
        return all(self._is_clear(np.array(s.bounding_box()), gap) for s in solids)

    def covers(self, point: np.ndarray, gap: float) -> bool:
        """Whether a point is within a gap of the boxes of what was added."""
        return any(
            np.all(point > b[:3] - gap) and np.all(point < b[3:] + gap)
            for b in self._boxes
        )

    def _is_clear(self, bounds: np.ndarray, gap: float) -> bool:
        low, high = bounds[:3] - gap, bounds[3:] + gap
        if np.any(np.all((self.sweep > low) & (self.sweep < high), axis=1)):
            return False
        low, high = bounds[:3] + 1e-3, bounds[3:] - 1e-3
        return all(np.any(high < b[:3]) or np.any(low > b[3:]) for b in self._boxes)


def draw_tables(layout: Layout, mount: Mount, rng: Rng) -> list[Top]:
    """Up to two tables around the arm, their corners (x, y) and heights."""
    wanted = int(rng.choice([0, 1, 2], p=[0.25, 0.5, 0.25]))
    if mount.kind == "table":
        wanted = 0
    found: list[Top] = []
    for _ in range(_TRIES):
        if len(found) == wanted:
            break
        half = layout.reach * rng.uniform(0.2, 0.45, 2)
        half, angle = np.clip(half, 0.2, 0.9), rng.uniform(0, 2 * np.pi)
        away = layout.reach * rng.uniform(0.3, 0.9) + half.max()
        middle = away * np.array([np.cos(angle), np.sin(angle)])
        height = float(np.clip(mount.bases[0, 2] + rng.uniform(-0.4, 0.4), 0.2, 1.0))
        whole = block(middle - half, middle + half, height)
        if layout.is_clear([whole]):
            layout.add([whole])
            found.append((middle - half, middle + half, height))
    return found


def block(lower: np.ndarray, upper: np.ndarray, height: float) -> Manifold:
    """All that a table keeps others from."""
    return box((*(lower + upper) / 2, height / 2), (*(upper - lower), height))


def draw_fixtures(layout: Layout, tops: list[Top], on_floor: bool, rng: Rng) -> Solids:
    """Up to six fixtures on tables, or some of them on the floor within reach."""
    placed: Solids = []
    wanted = int(rng.integers(0, 7))
    for _ in range(_TRIES):
        if len(placed) >= wanted:
            break
        kind = FIXTURES[int(rng.integers(len(FIXTURES)))]
        size = np.clip(layout.reach * rng.uniform(0.1, 0.3), 0.06, 0.6)
        solid = fixture(kind, float(size), rng)
        if tops and not (on_floor and rng.random() < 0.15):
            low, high, height = tops[int(rng.integers(len(tops)))]
            place = np.append(rng.uniform(low, high), height)
            solid = upright(solid, place, rng.uniform(0, np.pi))
            bounds = np.array(solid.bounding_box())
            fits = np.all(bounds[:2] >= low) and np.all(bounds[3:5] <= high)
        else:
            angle = rng.uniform(0, 2 * np.pi)
            away = layout.reach * rng.uniform(0.3, 0.9)
            place = away * np.array([np.cos(angle), np.sin(angle), 0])
            solid, fits = upright(solid, place, rng.uniform(0, np.pi)), True
        if fits and layout.is_clear([solid]):
            layout.add([solid])
            placed.append(solid)
    return placed


def aim_camera(
    layout: Layout, target: np.ndarray, size: tuple[int, int], rng: Rng
) -> Camera:
    """A depth camera somewhere around, which sees the whole or a part of it."""
    lower, upper = np.quantile(target, (0.01, 0.99), axis=0)
    center, radius = (lower + upper) / 2, np.linalg.norm(upper - lower) / 2
    for _ in range(_TRIES):
        away = rng.uniform(*DISTANCES) * radius / np.sin(_HALF_FIELD)
        away = np.clip(away, NEAREST, FARTHEST)
        azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 0.9)
        eye = center + away * direction(azimuth, elevation)
        seen = center + rng.normal(0, 0.12, 3) * radius
        nearest = np.linalg.norm(layout.sweep - eye, axis=1).min()
        if eye[2] > 0.3 and nearest > 0.4 and not layout.covers(eye, 0.3):
            return l515_camera(camera_axes(seen - eye), eye).resized(*size)
    raise ValueError("no place for the camera")


def draw_in_the_way(
    layout: Layout, eye: np.ndarray, swept: np.ndarray, rng: Rng
) -> tuple[Solids, Solids]:
    """Clutter and people around the arm, many of them before it, who together do not
    hide more of it than `HIDDEN` in any frame."""
    clutter: Solids = []
    people: Solids = []
    pieces = int(rng.integers(0, 5))
    for number in range(pieces + int(rng.choice(len(PERSON_SHARES), p=PERSON_SHARES))):
        for _ in range(6):
            is_person, where = number >= pieces, _place(layout, eye, rng)
            made = _person(where, rng) if is_person else _piece(where, eye, rng)
            if not layout.is_clear(made) or any(_near(s, eye) for s in made):
                continue
            whole, few = to_mesh([*clutter, *people, *made]), swept[:, ::4]
            if are_hidden(whole, few, eye).mean(axis=1).max() > HIDDEN:
                continue
            layout.add(made)
            (people if is_person else clutter).extend(made)
            break
    return clutter, people


def _place(layout: Layout, eye: np.ndarray, rng: Rng) -> np.ndarray:
    """Before the arm, or beside it, at the height of a part of it."""
    part = layout.sweep[int(rng.integers(len(layout.sweep)))]
    if rng.random() < 0.65:
        return eye + rng.uniform(0.25, 0.9) * (part - eye)
    angle, away = rng.uniform(0, 2 * np.pi), layout.reach * rng.uniform(0.7, 1.5) + 0.3
    return np.array([away * np.cos(angle), away * np.sin(angle), part[2]])


def _person(where: np.ndarray, rng: Rng) -> Solids:
    turn = (0.0, 0.0, float(rng.uniform(0, 360)))
    place = (float(where[0]), float(where[1]), 0.0)
    return [solid.rotate(turn).translate(place) for solid in random_person(rng)]


def _piece(where: np.ndarray, eye: np.ndarray, rng: Rng) -> Solids:
    """A box, a cabinet, a post or a fence on the floor, up to about `where`."""
    ground = np.array([*where[:2], 0.0])
    tall = max(where[2] + rng.uniform(-0.2, 0.2), 0.2)
    kind = rng.choice(["box", "cabinet", "post", "fence"], p=[0.4, 0.2, 0.15, 0.25])
    if kind == "fence":
        toward = np.arctan2(where[1] - eye[1], where[0] - eye[0])
        turn = toward + np.pi / 2 + rng.uniform(-0.3, 0.3)
        solid = fence(rng.uniform(0.7, 2.2), max(tall, 0.7), rng)
        return [upright(solid, ground, turn)]
    if kind == "box":
        size = (*np.maximum(rng.uniform(0.15, 0.5, 2), 0.25 * tall), tall)
    elif kind == "cabinet":
        size = (rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6), rng.uniform(0.7, 1.5))
    else:
        size = (0.06, 0.06, rng.uniform(1.0, 2.2))
    solid = box((0, 0, size[2] / 2), size, 0.005)
    return [upright(solid, ground, rng.uniform(0, np.pi))]


def _near(solid: Manifold, eye: np.ndarray) -> bool:
    bounds = np.array(solid.bounding_box())
    return bool(np.all(np.maximum(bounds[:3] - eye, eye - bounds[3:]) < 0.3))


def draw_room(target: np.ndarray, eye: np.ndarray, rng: Rng) -> trimesh.Trimesh:
    """The floor, and up to two walls behind all that the camera looks at."""
    corners = ROOM * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    meshes = [trimesh.Trimesh(corners, faces, process=False)]
    center = target.mean(axis=0)
    toward = np.arctan2(eye[1] - center[1], eye[0] - center[0])
    for side in rng.permutation([-1, 1])[: int(rng.integers(0, 3))]:
        bearing = toward + side * rng.uniform(0.1, 0.7)
        normal = np.array([np.cos(bearing), np.sin(bearing), 0.0])
        along = np.array([-normal[1], normal[0], 0.0])
        middle = ((target @ normal).min() - rng.uniform(0.1, 2.0)) * normal
        wall = [
            middle + x * ROOM * along + (0, 0, z)
            for x, z in ((-1, 0), (1, 0), (1, 4), (-1, 4))
        ]
        meshes.append(trimesh.Trimesh(wall, faces, process=False))
    return together(meshes)
