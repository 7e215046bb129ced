"""Procedural object meshes by category and seed.

Each category has a function that draws one object from a NumPy generator and returns
its solids. Canonical pose, never rotated at random: z up, front along +y, floor at
z = 0; mostly in metres. Each mesh is the boolean union of closed solids, so it is
watertight and a point sampled on it lies on the outer surface.
"""

import zlib

import numpy as np
import trimesh

from experiments.simulation.shapes import (
    arms,
    beds,
    benches,
    bicycles,
    cabinets,
    conveyors,
    drives,
    fans,
    fixtures,
    forklifts,
    furniture,
    gantries,
    grippers,
    interior,
    ladders,
    machine_frames,
    monitors,
    pallets,
    piping,
    pumps,
    tanks,
    valves,
    vehicles,
    vessels,
)
from experiments.simulation.solids import as_mesh, union

_TRAIN = {
    "chair": furniture.chair,
    "table": furniture.table,
    "sofa": interior.sofa,
    "cabinet": interior.cabinet,
    "lamp": interior.lamp,
    "bottle": vessels.bottle,
    "mug": vessels.mug,
    "airplane": vehicles.airplane,
    "car": vehicles.car,
    "arm": arms.arm,
    "bed": beds.bed,
    "machine_frame": machine_frames.machine_frame,
    "conveyor": conveyors.conveyor,
    "gearbox": drives.gearbox,
    "pipe_run": piping.pipe_run,
    "pallet": pallets.pallet,
    "control_cabinet": cabinets.control_cabinet,
    "fixture": fixtures.fixture,
}
_UNSEEN = {
    "bench": benches.bench,
    "bowl": vessels.bowl,
    "monitor": monitors.monitor,
    "gantry": gantries.gantry,
    "gripper": grippers.gripper,
    "valve": valves.valve,
}
_NOVEL = {
    "ladder": ladders.ladder,
    "fan": fans.fan,
    "bicycle": bicycles.bicycle,
    "forklift": forklifts.forklift,
    "pump": pumps.pump,
    "tank": tanks.tank,
}
_BUILDERS = _TRAIN | _UNSEEN | _NOVEL
TRAIN_CATEGORIES = tuple(_TRAIN)
UNSEEN_CATEGORIES = tuple(_UNSEEN)
"""Kept from training, to see what becomes of kinds of object never met before."""
NOVEL_CATEGORIES = tuple(_NOVEL)
"""Kept from training too, to choose by what helps on kinds never met, so that nothing
is ever chosen by the unseen ones."""
CATEGORIES = TRAIN_CATEGORIES + UNSEEN_CATEGORIES + NOVEL_CATEGORIES
"""Category names; an index into it is the category of an example."""


def category_rng(category: str, *seed: int) -> np.random.Generator:
    """Generator of a stream for a category and non-negative seeds.

    Streams do not depend on the order or the number of categories. NumPy fills seeds up
    with zeros and cuts large ones into words of 32 bits, so that (n, 1) and n + 2**32
    are one stream: the views of a training shape and another split's mesh may share it.
    """
    return np.random.default_rng([zlib.crc32(category.encode()), *seed])


def make_shape(category: str, seed: int) -> trimesh.Trimesh:
    """A watertight mesh, a pure function of the category and a non-negative seed."""
    if category not in _BUILDERS:
        known = ", ".join(CATEGORIES)
        raise ValueError(f"unknown category {category!r}: choose one of {known}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    return as_mesh(union(_BUILDERS[category](category_rng(category, seed))))
