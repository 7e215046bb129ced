"""Procedural plunger pumps with a belt drive, and the feet that other pumps borrow."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.shapes.drives import motor
from experiments.simulation.shapes.valves import flange
from experiments.simulation.solids import Solids, box, ring_of, rod, side_profile, tube

Rng = np.random.Generator


def foot(center: tuple, size: tuple, low: float) -> Solids:
    """A plate on the floor `low`, sunk into it a little, and a web up to the centre."""
    x, y, z = center
    web = box((x, y, (z + low) / 2), (size[0] * 0.5, size[1] * 0.6, z - low))
    return [web, box((x, y, low + 0.01), (*size, 0.028))]


def plunger_pump(rng: Rng) -> Solids:
    """A crankcase with two to four plungers in a row before it, a motor behind."""
    count, pitch = int(rng.integers(2, 5)), rng.uniform(0.09, 0.13)
    wide, deep = count * pitch + 0.08, rng.uniform(0.26, 0.36)
    tall, low = rng.uniform(0.24, 0.32), 0.06
    arc = np.linspace(0, np.pi, 9)
    roof = np.stack([deep / 2 * np.cos(arc), 0.3 * tall * np.sin(arc)], axis=1)
    case = [
        (-deep / 2, 0.5 * low),
        (deep / 2, 0.5 * low),
        *(roof + (0, low + 0.7 * tall)),
    ]
    solids = [side_profile(np.array(case), wide)]
    solids += _fluid_end(rng, count, pitch, deep, low + 0.4 * tall)
    size, long = rng.uniform(0.1, 0.13), rng.uniform(0.3, 0.4)
    shaft = np.array((wide / 2, 0.0, low + 0.62 * tall))
    drive = np.array((wide / 2, -deep / 2 - 1.6 * size, low + 1.15 * size))
    solids += _belt(rng, shaft, drive)
    parts = [p.rotate((0, 0, 90)).rotate((0, -90, 0)) for p in motor(rng, size, long)]
    start = drive - (0.03, 0, 0)
    solids += [part.translate(start) for part in parts]
    hold = (start[0] - 0.4 * long, start[1], start[2] - 0.6 * size)
    solids += foot(hold, (0.6 * long, 2 * size), low)
    front, back = deep / 2 + 0.1, drive[1] - size
    middle = (-0.04, (front + back) / 2, low / 2)
    return [*solids, box(middle, (wide + 0.16, front - back, low))]


def _fluid_end(rng: Rng, count: int, pitch: float, deep: float, level: float) -> Solids:
    """Cylinders from the crankcase to a block of valves, and two pipes through that."""
    front, solids = deep / 2 + rng.uniform(0.14, 0.22) + 0.05, []
    for k in range(count):
        x = (k - (count - 1) / 2) * pitch
        solids.append(rod((x, 0, level), (x, front, level), 0.36 * pitch))
        cap = (x, front, level - 0.1), (x, front, level + 0.16)
        solids.append(rod(*cap, 0.3 * pitch, segments=6))
    wide = count * pitch + 0.02
    solids.append(box((0, front, level), (wide, 0.13, 0.18), 0.012))
    for z, size in ((-0.06, 0.035), (0.06, 0.025)):
        start = (-0.7 * wide - 0.05, front, level + z)
        end = (0.5 * wide + 0.03, front, level + z)
        solids.append(tube(start, end, size, 0.7 * size))
        solids += flange(start, (-1, 0, 0), 2 * size, 0.6 * size, 4, 0.7 * size)
    return solids


def _belt(rng: Rng, shaft: np.ndarray, drive: np.ndarray) -> Solids:
    """A spoked pulley on the shaft, a small one on the drive, both at the case's side,
    and the belt around them."""
    wheel, side = rng.uniform(0.13, 0.19), np.array((0.05, 0.0, 0.0))
    wide, middle = np.array((0.07, 0.0, 0.0)), shaft + (0.085, 0, 0)
    spoke = rod((0, 0, 0), (0.9 * wheel, 0, 0), 0.014, segments=8)
    solids = [p.rotate((0, 90, 0)).translate(middle) for p in ring_of(spoke, 5)]
    solids.append(tube(shaft + side, shaft + side + wide, wheel, 0.8 * wheel, 30))
    solids.append(rod(shaft * (0, 1, 1), shaft + (0.14, 0, 0), 0.025))
    solids.append(rod(drive + side, drive + side + wide, 0.4 * wheel, segments=22))
    solids.append(rod(drive - (0.1, 0, 0), drive + side + wide, 0.02))
    outer, inner = [], []
    for point, size in ((shaft, wheel), (drive, 0.4 * wheel)):
        near, far = point + (0.07, 0, 0), point + (0.1, 0, 0)
        outer.append(rod(near, far, size + 0.007, segments=24))
        inner.append(rod(near - side, far + side, size - 0.008, segments=24))
    return [*solids, Manifold.batch_hull(outer) - Manifold.batch_hull(inner)]
