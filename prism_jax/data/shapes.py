"""Procedural object meshes by category and seed.

Canonical pose, never rotated at random: z up, front along +y. Each mesh is the
boolean union of closed solids, so it is watertight and a point sampled on it lies on
the outer surface. Lengths are in arbitrary units of the order of one.
"""

import zlib

import numpy as np
import trimesh

from prism_jax.data import arms, furniture, interior, vehicles, vessels
from prism_jax.data.solids import union

_BUILDERS = {
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
}
CATEGORIES = tuple(_BUILDERS)
"""Category names; an index into it is the category of an example."""


def category_rng(category: str, *seed: int) -> np.random.Generator:
    """Generator of its own stream for a category and non-negative seeds.

    Streams do not depend on the order or the number of categories.
    """
    return np.random.default_rng([zlib.crc32(category.encode()), *seed])


def make_shape(category: str, seed: int) -> trimesh.Trimesh:
    """A watertight mesh, a pure function of the category and a non-negative seed.

    An unknown category or a negative seed raises ValueError.
    """
    if category not in _BUILDERS:
        known = ", ".join(CATEGORIES)
        raise ValueError(f"unknown category {category!r}: choose one of {known}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    solid = union(_BUILDERS[category](category_rng(category, seed)))
    mesh = solid.to_mesh64()
    vertices = np.array(mesh.vert_properties)[:, :3]
    return trimesh.Trimesh(vertices, np.array(mesh.tri_verts), process=False)
