"""The simulator is frozen: what a seed gives stays what it was.

Four draws of each builder, or all twenty, are compared with summaries in frozen.json,
to a tolerance since a mesh differs in its last digits between machines. A draw more or
less, or in another order, changes them.
`python -m tests.experiments.simulation.test_frozen` writes them anew.
"""

import dataclasses
import functools
import json
import pathlib
import tempfile

import numpy as np
import pytest
import trimesh

from experiments.simulation.kinds import MIXTURE, make_view
from experiments.simulation.open_shapes import make_open_shape
from experiments.simulation.partials import PARTIALS
from experiments.simulation.raycast import Scene
from experiments.simulation.roboarm.cell_views import make_cell_view
from experiments.simulation.roboarm.models import ArmModel
from experiments.simulation.roboarm.sequences import (
    SURVEY,
    RoboArmConfig,
    make_sequence,
    survey,
)
from experiments.simulation.roboarm.workcells import make_workcell
from experiments.simulation.scenes.arrangement import arranged, random_room
from experiments.simulation.scenes.sensing import random_camera, random_lidar
from experiments.simulation.sensors import (
    L515Config,
    OusterConfig,
    l515_camera,
    l515_depth,
)
from experiments.simulation.sensors import ouster_scan as scan
from experiments.simulation.shapes import CATEGORIES, make_shape
from prism_jax.data.recordings import LABELS
from tests.experiments.simulation.roboarm.conftest import URDF

EXPECTED = pathlib.Path(__file__).with_name("frozen.json")
DRAWS = 20


def of_mesh(mesh: trimesh.Trimesh) -> list[float]:
    return [mesh.area, *mesh.extents]


@functools.cache
def chair() -> tuple[Scene, np.ndarray]:
    mesh = make_shape("chair", 0)
    lower, upper = mesh.bounds
    corners = (mesh.vertices - (lower + upper) / 2) / ((upper - lower).max() / 2)
    scene = Scene(trimesh.Trimesh(corners, mesh.faces, process=False))
    return scene, np.asarray(scene.mesh.sample(2048, seed=0))


@functools.cache
def boxes() -> ArmModel:
    """A robot of boxes: every machine has it."""
    path = pathlib.Path(tempfile.mkdtemp()) / "boxes.urdf"
    path.write_text(URDF)
    return ArmModel("boxes", "test", str(path))


def shares(image: np.ndarray, kinds: int) -> np.ndarray:
    """How much of an image each kind is, to a few pixels."""
    return 1 + np.bincount(image.ravel(), minlength=kinds) / image.size


def view(kind: str, seed: int) -> list[float]:
    """Whether there is any, where its sensor stood, how far points are from it, and
    how much of its map has each state."""
    points, eye, _, known = make_view(kind, *chair(), np.random.default_rng(seed), 2048)
    far = np.linalg.norm(points - eye, axis=1).mean() if len(points) else 0.0
    states = [1.0] * 4 if known is None else shares(known.state, 4)
    return [float(len(points) > 0), *eye, far, *states]


def noise_of(config, read) -> float:
    """How far readings with the noise alone are from exact ones."""
    exact = config.exact()
    noisy = dataclasses.replace(exact, noise=config.noise)
    a, b = (
        read(np.random.default_rng(0), each).astype(float) for each in (exact, noisy)
    )
    return np.abs(a - b).mean()


def sensors(seed: int) -> list[float]:
    scene, rng = chair()[0], np.random.default_rng(seed)
    eye = np.array([3.0, seed / 10, 0.0])
    axes = np.array([(0, 1.0, 0), (0, 0, -1.0), (-1.0, 0, 0)])
    camera = l515_camera(axes, eye).resized(60, 80)
    lidar = OusterConfig(beams=32, columns=256)
    counts, _ = l515_depth(scene, camera, rng)
    ranges = scan(scene, eye, rng, lidar).ranges
    return [
        (counts > 0).mean(),
        counts[counts > 0].mean(),
        ranges.mean(),
        rng.random(),
        noise_of(L515Config(), lambda *how: l515_depth(scene, camera, *how)[0]),
        noise_of(lidar, lambda *how: scan(scene, eye, *how).ranges),
    ]


def scene_layout(seed: int) -> list[float]:
    rng = np.random.default_rng(seed)
    support = "table" if seed % 2 else "floor"
    meshes = arranged([trimesh.creation.box()] * 4, support, rng)
    room = random_room(meshes, support, rng)
    things = trimesh.util.concatenate(meshes)
    make = random_lidar if seed % 4 == 0 else random_camera
    sensor = make(Scene(things), room.has_wall, 10.0 * seed, rng)
    around = trimesh.util.concatenate([part.mesh for part in room.parts])
    eye, directions = sensor.rays
    return [*of_mesh(things), *of_mesh(around), *eye, directions.size, rng.random()]


def sequence(seed: int) -> list[float]:
    rng = np.random.default_rng(seed)
    made = make_sequence(boxes(), 3, RoboArmConfig(num_waypoints=2), rng)
    cell = made.cell
    meshes = [m for m in (cell.support, cell.fixtures, cell.clutter) if len(m.faces)]
    return [
        *of_mesh(trimesh.util.concatenate(meshes)),
        *made.positions[-1],
        *np.asarray(cell.camera.translation),
        rng.random(),
    ]


def surveyed(seed: int) -> list[float]:
    """Where the points of the ground truth are, of every other face of a chair."""
    scene, rng = chair()[0], np.random.default_rng(seed)
    wanted = np.arange(len(scene.mesh.faces)) % 2 == 0
    config = dataclasses.replace(SURVEY, beams=48, columns=384)
    points = survey(scene, wanted, 300, rng, config=config)
    return [*(2 + points.mean(axis=0)), *points.std(axis=0)]


def workcell(seed: int) -> list[float]:
    rng = np.random.default_rng(seed)
    try:
        cell = make_workcell(boxes(), 2, rng, (60, 80))
    except ValueError:
        return [0.0] * 7 + [rng.random()] + [0.0] * 9
    eye = np.asarray(cell.camera.position)
    parts = trimesh.util.concatenate(list(cell.parts(1).values()))
    made = [*of_mesh(parts), *eye, rng.random()]
    try:
        seen = make_cell_view(cell, 1, rng, num_partial=64, num_complete=64)
    except ValueError:
        return [*made, *[0.0] * 9]
    return [*made, *shares(seen.labels, len(LABELS)), *shares(seen.visibility.state, 4)]


BUILDERS = {
    **{name: functools.partial(make_shape, name) for name in CATEGORIES},
    "open": make_open_shape,
    **{f"view {kind}": functools.partial(view, kind) for kind in (*PARTIALS, *MIXTURE)},
    "sensors": sensors,
    "scene": scene_layout,
    "sequence": sequence,
    "surveyed": surveyed,
    "workcell": workcell,
}


def draw(name: str, seed: int) -> list[float]:
    made = BUILDERS[name](seed)
    return of_mesh(made) if isinstance(made, trimesh.Trimesh) else made


@pytest.mark.parametrize("count", [4, pytest.param(DRAWS, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", BUILDERS)
def test_every_draw_is_what_it_was(name, count):
    draws = np.array([draw(name, seed) for seed in range(count)])
    expected = np.array(json.loads(EXPECTED.read_text())[name])
    np.testing.assert_allclose(draws, expected[:count], rtol=1e-3, atol=1e-4)
    if count == DRAWS:
        assert len(np.unique(draws, axis=0)) > DRAWS / 2
        np.testing.assert_array_equal(draw(name, 3), draws[3])


if __name__ == "__main__":
    drawn = {name: [draw(name, seed) for seed in range(DRAWS)] for name in BUILDERS}
    rounded = {
        name: [[float(f"{value:.5g}") for value in row] for row in rows]
        for name, rows in drawn.items()
    }
    lines = [
        f"{json.dumps(name)}: {json.dumps(rows)}" for name, rows in rounded.items()
    ]
    EXPECTED.write_text("{\n" + ",\n".join(lines) + "\n}\n")
