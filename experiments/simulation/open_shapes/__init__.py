"""Random shapes without a kind: primitives and structures cut, joined and repeated.

What a network learns of completing from such shapes is not bound to a list of kinds.
z is up, the floor at z = 0. Each is one closed solid in one piece; a part fills, or
nearly, a box of the given size about the origin. Sources: D. Xie et al., LRM-Zero,
2024; H. Jiang et al., MegaSynth, 2025: reconstruction trained on random primitives
alone comes close to training on collected models.
"""

import trimesh

from experiments.simulation.open_shapes.compositions import composition
from experiments.simulation.shapes import category_rng
from experiments.simulation.solids import as_mesh, on_floor

CATEGORY = "open"  # of all of them


def make_open_shape(seed: int) -> trimesh.Trimesh:
    """A watertight mesh, a pure function of a non-negative seed; a negative one raises
    ValueError."""
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    return as_mesh(*on_floor([composition(category_rng(CATEGORY, seed))]))
