"""People as plain capsules, standing or leaning forward, who stand in a sensor's way.

Metres, z up, upright at the origin on z = 0, facing +x.
"""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import ball, capsule

HEIGHTS = (1.5, 1.95)


def random_person(rng: np.random.Generator) -> list[Manifold]:
    """Legs, trunk, head and arms, each of which hangs or reaches out by itself."""
    height = rng.uniform(*HEIGHTS)
    hip, shoulder = 0.5 * height, 0.8 * height
    lean = height * rng.uniform(-0.03, 0.12)
    breadth = height * rng.uniform(0.1, 0.13)
    chest = np.array([lean, 0, shoulder])
    solids = [
        capsule((0, 0, hip), chest - (0, 0, 0.03), 0.075 * height, 0.085 * height),
        ball(chest + (0.3 * lean, 0, 0.125 * height), 0.068 * height),
    ]
    stride = height * rng.uniform(-0.12, 0.12)
    for side in (-1, 1):
        foot = (side * stride, side * 0.07 * height, 0.035 * height)
        knee = (side * stride * 0.6 + 0.02, side * 0.065 * height, 0.27 * height)
        solids.append(capsule(foot, knee, 0.035 * height, 0.04 * height, 12))
        top = (0, side * 0.05 * height, hip)
        solids.append(capsule(knee, top, 0.04 * height, 0.055 * height, 12))
        joint = chest + (0, side * (breadth + 0.03 * height), 0)
        raised = rng.choice([rng.uniform(-0.3, 0.3), rng.uniform(0.4, 1.7)])
        bent = raised + rng.uniform(0, 1.3)
        elbow = joint + 0.18 * height * _hanging(raised)
        hand = elbow + 0.2 * height * _hanging(bent)
        solids.append(capsule(joint, elbow, 0.032 * height, 0.028 * height, 12))
        solids.append(capsule(elbow, hand, 0.028 * height, 0.025 * height, 12))
    return solids


def _hanging(angle: float) -> np.ndarray:
    """Downwards, raised to the front by an angle in radians."""
    return np.array([np.sin(angle), 0, -np.cos(angle)])
