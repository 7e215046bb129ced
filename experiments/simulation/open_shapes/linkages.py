"""Random linkages: chains of links, each turned against the one before at a joint."""

import numpy as np
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from experiments.simulation.open_shapes.attachments import touched
from experiments.simulation.open_shapes.primitives import Rng, Size, block, primitive
from experiments.simulation.solids import bar, box, capsule, place, rod, union

LINKS = ("rod", "bar", "capsule", "plates", "hull")


def linkage(rng: Rng, size: Size) -> Manifold:
    """A base, two to five links in a random posture above it, and what they hold."""
    count, thick = (
        int(rng.integers(2, 6)),
        np.exp(rng.uniform(np.log(0.05), np.log(0.25))),
    )
    lengths = rng.uniform(0.5, 1.2, count) * rng.uniform(0.7, 1.0) ** np.arange(count)
    radii = thick * np.linspace(1.0, rng.uniform(0.4, 1.0), count + 1) / 2
    base = rng.uniform([2, 2, 0.5], [8, 8, 4]) * thick
    solids = [block(rng, base)]
    point, frame = np.array([0.0, 0.0, base[2] / 2]), np.eye(3)
    kind, rolls = str(rng.choice(LINKS)), rng.random() < 0.4
    for index, length in enumerate(lengths):
        bend = rng.uniform(-0.9, 0.9) if index == 0 else rng.uniform(-2.2, 2.2)
        roll = rng.uniform(-np.pi, np.pi) if rolls else 0.0
        turned = [frame @ _turn(roll, angle) for angle in (bend, -bend)]
        # Of the two ways to bend, the one that keeps off the floor.
        is_low = point[2] + length * turned[0][2, 2] < 0
        frame = turned[int(is_low)]
        solids += _link(rng, kind, point, frame, length, radii[index : index + 2])
        point = point + length * frame[:, 2]
    held = primitive(rng, radii[-1] * np.exp(rng.uniform(np.log(2), np.log(12), 3)))
    foot = touched(held, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    if foot is not None:
        sink = foot.point + (0, 0, min(foot.depth, radii[-1]) / 2)
        solids.append(place(held.translate(-sink), frame, point))
    return _within(union(solids), size)


def _turn(roll: float, bend: float) -> np.ndarray:
    """About the link's own axis, z, then about its joint's, x."""
    return Rotation.from_euler("ZX", (roll, bend)).as_matrix()


def _link(
    rng: Rng,
    kind: str,
    start: np.ndarray,
    frame: np.ndarray,
    length: float,
    radii: np.ndarray,
) -> list[Manifold]:
    """A joint across x at the start, and the body from there along z."""
    end, axis = start + length * frame[:, 2], frame[:, 0]
    wide, slim = radii
    joint = rod(start - 1.6 * wide * axis, start + 1.6 * wide * axis, 1.2 * wide)
    if kind == "rod":
        return [joint, rod(start, end, 0.9 * wide, 0.9 * slim, 14)]
    if kind == "capsule":
        return [joint, capsule(start, end, wide, slim, 12)]
    if kind == "bar":
        return [joint, bar(start, end, 1.6 * wide, 1.2 * wide, slim / wide)]
    if kind == "hull":
        ends = [
            rod(point - radius * axis, point + radius * axis, radius, segments=14)
            for point, radius in ((start, wide), (end, slim))
        ]
        return [joint, Manifold.batch_hull(ends)]
    plates = [
        box((side * wide, 0, length / 2), (0.5 * wide, 1.6 * wide, length + wide))
        for side in (-1, 1)
    ]
    pin = rod(end - 1.2 * wide * axis, end + 1.2 * wide * axis, 0.7 * wide)
    return [joint, pin, *(place(plate, frame, start) for plate in plates)]


def _within(solid: Manifold, size: Size) -> Manifold:
    """The solid, centred, as large as the box takes it."""
    lower, upper = np.array(solid.bounding_box()).reshape(2, 3)
    scale = float((size / (upper - lower)).min())
    return solid.translate(-(lower + upper) / 2).scale((scale, scale, scale))
