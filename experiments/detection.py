"""Measures how small a body free space never holds, by sensor and distance.

    python -m experiments.detection --output=FILE.json

A ball or an upright post stands before a wall, straight ahead or at the side of the
view, and returns light or none. For each diameter free space is carved for bodies of
that size (`prism_jax.envelope.carving`), at random places of the body. Beside the table
stands how much of the bundled robot cells is free.
"""

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from absl import flags
from jaxtyping import Float
from tqdm import tqdm

from experiments.assets import CELLS
from experiments.output import prepare_output
from experiments.run_folder import commit
from experiments.scoring import print_and_write
from prism_jax.cli.launch import launch
from prism_jax.data.recordings import DEPTH_SCALE, RecordedCells
from prism_jax.envelope.carving import Carving, CloudView, DepthView, carve
from prism_jax.envelope.voxels import Grid
from prism_jax.evaluation.tables import table_lines
from prism_jax.geometry.camera import Camera
from prism_jax.io.depth import points_from_depth

FLAGS = flags.FLAGS

DIAMETERS = (0.02, 0.04, 0.08, 0.12, 0.2)  # metres, as all lengths here
DISTANCES = (1.0, 2.0, 3.0, 5.0)
ASIDE = (0.0, 25.0)  # degrees from straight ahead
BEHIND = 1.5  # from the body to the wall
HALF = 0.3  # half the side of the box that is carved, about the body's usual place
RINGS = {  # how many, and over how many degrees
    "LiDAR, 64 rings": (64, 33.0),
    "LiDAR, 16 rings": (16, 30.0),
}
CAMERA = "depth camera, 640x480, 70x55 degrees"

Rays = Float[np.ndarray, "N 3"]


def rays_of(sensor: str) -> Rays:
    """Directions from a sensor at the origin, +x ahead and z up. A camera's are of unit
    length along its axis, row by row."""
    if sensor == CAMERA:
        wide, high = np.tan(np.deg2rad([35.0, 27.5]))
        across = (np.arange(640) - 319.5) / 320 * wide
        down = (np.arange(480) - 239.5) / 240 * high
        y, z = np.meshgrid(-across, -down)
        return np.stack([np.ones_like(y), y, z], axis=-1).reshape(-1, 3)
    count, field = RINGS[sensor]
    elevation = np.deg2rad(np.linspace(-field / 2, field / 2, count))
    azimuth = np.deg2rad(np.arange(-60, 60, 0.2))
    el, az = map(np.ravel, np.meshgrid(elevation, azimuth, indexing="ij"))
    return np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], -1)


def hits(rays: Rays, center: np.ndarray, radius: float, post: bool) -> np.ndarray:
    """How far along each ray a ball or an upright post is; infinite where it is not."""
    axes = 2 if post else 3
    toward, place = rays[:, :axes], center[:axes]
    square, mixed = (toward**2).sum(axis=1), toward @ place
    root = mixed**2 - square * (place @ place - radius**2)
    near = (mixed - np.sqrt(np.maximum(root, 0.0))) / square
    return np.where((root >= 0) & (near > 0), near, np.inf)


def surface(
    center: np.ndarray, radius: float, post: bool, rng: np.random.Generator
) -> Float[np.ndarray, "N 3"]:
    """Points on a ball, or on what the box holds of a post."""
    unit = rng.normal(size=(2000, 3))
    unit[:, 2] *= not post
    unit *= radius / np.linalg.norm(unit, axis=1, keepdims=True)
    unit[:, 2] += post * rng.uniform(-2 * HALF, 2 * HALF, len(unit))
    return center + unit


def freed(
    sensor: str, rays: Rays, depth: np.ndarray, grid: Grid, body: float
) -> np.ndarray:
    """The free voxels, by depths along the rays that are infinite if none returned."""
    known = np.isfinite(depth)
    if sensor == CAMERA:
        focal = 320 / np.tan(np.deg2rad(35.0)), 240 / np.tan(np.deg2rad(27.5))
        intrinsics = np.array([[focal[0], 0, 319.5], [0, focal[1], 239.5], [0, 0, 1]])
        axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], float)
        camera = Camera(axes, np.zeros(3), intrinsics, 480, 640)
        view = DepthView(depth.reshape(480, 640), camera)
    else:
        view = CloudView(depth[known, None] * rays[known], np.zeros(3))
    return carve(grid, view, Carving(body=body)).ravel()


def measured(sensor: str, trials: int) -> list[dict[str, Any]]:
    """A row for each distance, direction and diameter: the share of the box before the
    wall that is free without a body, and in how many of the trials free space held some
    of the body's surface."""
    rays, rows = rays_of(sensor), []
    length = np.linalg.norm(rays, axis=1)
    places = list(itertools.product(DISTANCES, ASIDE, DIAMETERS))
    for distance, aside, diameter in tqdm(places, desc=sensor, mininterval=2.0):
        rng = np.random.default_rng(0)
        angle = np.deg2rad(aside)
        middle = distance * np.array([np.cos(angle), np.sin(angle), 0.0])
        grid = Grid.over(middle - HALF, middle + HALF)
        wall = (distance + BEHIND) / length
        empty = freed(sensor, rays, wall, grid, diameter)
        held = 0
        for trial, post, dark in itertools.product(
            range(trials), (False, True), (False, True)
        ):
            del trial
            center = middle + rng.uniform(-0.15, 0.15, 3)
            hit = hits(rays, center, diameter / 2, post)
            depth = np.where(hit < wall, np.inf if dark else hit, wall)
            free = freed(sensor, rays, depth, grid, diameter)
            index = grid.index_of(surface(center, diameter / 2, post, rng))
            held += bool(free[index[index >= 0]].any())
        row = {"distance": distance, "aside": aside, "diameter": diameter}
        rows.append({**row, "free": float(empty.mean()), "held": held})
    return rows


def smallest(rows: Sequence[dict[str, Any]], distance: float, aside: float) -> str:
    """The least diameter for which something is free, and no body of it ever was."""
    own = [r for r in rows if (r["distance"], r["aside"]) == (distance, aside)]
    good = [r["diameter"] for r in own if r["free"] > 0 and r["held"] == 0]
    return f"{100 * min(good):.0f} cm" if good else "none"


def bundled() -> dict[str, dict[str, float]]:
    """Of a cube of 3 m around the robots of the bundled frames, by view and diameter:
    free cubic metres a frame, and free voxels with measured or true surface."""
    cells, found = RecordedCells(CELLS), {}
    grid = Grid.over(np.array([-1.5, -1.5, 0.0]), np.array([1.5, 1.5, 3.0]))
    for frame in map(cells.read, range(len(cells))):
        assert frame.complete is not None
        depth, known = frame.depth * DEPTH_SCALE, frame.depth > 0
        cloud = points_from_depth(depth, known, frame.camera)
        views = {
            "depth image": DepthView(depth, frame.camera),
            "cloud": CloudView(cloud, np.asarray(frame.camera.position)),
        }
        surface = grid.index_of(np.concatenate([cloud, frame.complete]))
        surface = np.unique(surface[surface >= 0])
        for (name, view), body in itertools.product(views.items(), (0.02, 0.05)):
            free = carve(grid, view, Carving(body=body)).ravel()
            row = found.setdefault(f"{name}, {body} m", {"free": 0.0, "surface": 0})
            row["free"] += float(free.sum()) * grid.voxel**3 / len(cells)
            row["surface"] += int(free[surface].sum())
    return found


def table(sensors: Mapping[str, Sequence[dict[str, Any]]]) -> str:
    """A row for each sensor and direction, a column for each distance."""
    cells = [
        [name, f"{aside:.0f}", *(smallest(rows, r, aside) for r in DISTANCES)]
        for name, rows in sensors.items()
        for aside in ASIDE
    ]
    head = ["sensor", "degrees aside", *(f"{distance:.0f} m" for distance in DISTANCES)]
    return "\n".join(table_lines(head, cells))


def main() -> None:
    """Writes the table for every sensor."""
    prepare_output(FLAGS.output, ".json")
    sensors = {name: measured(name, FLAGS.trials) for name in (CAMERA, *RINGS)}
    bodies = 4 * FLAGS.trials
    held = sum(row["held"] for rows in sensors.values() for row in rows)
    result = {"sensors": sensors, "bodies": bodies, "held": held, "commit": commit()}
    result["bundled"] = bundled()
    shown = json.dumps(result["bundled"], indent=1)
    print_and_write(result, f"{table(sensors)}\n\n{shown}")


def define_flags() -> None:
    """The flags of this launcher."""
    flags.DEFINE_integer("trials", 10, "Places of each body.", 1)
    flags.DEFINE_string("output", None, "JSON file to write.")


def run() -> None:
    """The entry point."""
    define_flags()
    launch("detection", main)


if __name__ == "__main__":
    run()
