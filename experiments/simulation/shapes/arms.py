"""Procedural articulated arms: a pedestal, three to six links, a gripper.

The base yaws about z, the next two joints pitch, and the wrist mixes roll and pitch,
as in the common industrial layouts. The pose is drawn within joint limits, and drawn
again while a link reaches the floor or comes close to one that is not its neighbour.
"""

from typing import NamedTuple

import numpy as np
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from experiments.simulation.solids import Rng, ball, box, capsule, lathe, place, rod

MAX_POSES = 60


class Chain(NamedTuple):
    """Row i belongs to link i: `hinges` is its joint, `starts` and `ends` its centre
    line, `frames` its rotation (x the pitch axis, z along the link)."""

    hinges: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    frames: np.ndarray
    radii: np.ndarray


def arm(rng: Rng) -> list[Manifold]:
    """One arm in a random posture."""
    num_links = int(rng.integers(3, 7))
    height, radius = rng.uniform(0.15, 0.5), rng.uniform(0.07, 0.12)
    lengths = rng.uniform(0.35, 0.65, num_links)
    lengths[2:] *= rng.uniform(0.35, 0.8, num_links - 2)
    slim = rng.uniform(0.5, 0.7)
    radii = radius * rng.uniform(0.8, 1.0) * np.linspace(1.0, slim, num_links)
    steps = np.zeros(num_links)
    if rng.random() < 0.4:
        steps[:2] = (1.9 * radius, -1.7 * radius)
    chain = posed_chain(rng, height, lengths, radii, steps)
    style = str(rng.choice(["tube", "box", "capsule", "shell", "yoke"]))
    solids = _base(rng, height, radius)
    for index in range(num_links):
        solids += _link(style, chain, index)
    return solids + _tool(rng, chain)


def posed_chain(
    rng: Rng, height: float, lengths: np.ndarray, radii: np.ndarray, steps: np.ndarray
) -> Chain:
    """The first random pose that is free of collisions, by centre-line distances, or
    the last of `MAX_POSES`. `steps` moves link i sideways along its joint's axis."""
    for _ in range(MAX_POSES - 1):
        chain = _forward(rng, height, lengths, radii, steps)
        if _is_free(chain):
            return chain
    return _forward(rng, height, lengths, radii, steps)


def _forward(
    rng: Rng, height: float, lengths: np.ndarray, radii: np.ndarray, steps: np.ndarray
) -> Chain:
    rotation = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    point, rows = np.array([0.0, 0.0, height]), []
    for index, (length, step) in enumerate(zip(lengths, steps, strict=True)):
        pitch = rng.uniform(-0.9, 0.9) if index == 0 else rng.uniform(-2.1, 2.1)
        roll = rng.choice([0.0, rng.uniform(-np.pi, np.pi)]) if index > 1 else 0.0
        rotation = rotation * Rotation.from_euler("ZX", (roll, pitch))
        frame = rotation.as_matrix()
        start = point + step * frame[:, 0]
        end = start + length * frame[:, 2]
        rows.append((point, start, end, frame))
        point = end
    hinges, starts, ends, frames = (np.array(c) for c in zip(*rows, strict=True))
    return Chain(hinges, starts, ends, frames, radii)


def _is_free(chain: Chain) -> bool:
    share = np.linspace(0, 1, 9)[:, None]
    lines = [
        start + share * (end - start)
        for start, end in zip(chain.starts, chain.ends, strict=True)
    ]
    for index, line in enumerate(lines):
        if line[-1, 2] < 2 * chain.radii[index] + 0.08:
            return False
        if index and np.hypot(*line[-1, :2]) < 0.25 and line[-1, 2] < 0.5:
            return False
        for other in range(index - 1):
            gaps = np.linalg.norm(line[:, None] - lines[other][None], axis=-1)
            if gaps.min() < 1.4 * (chain.radii[index] + chain.radii[other]):
                return False
    return True


def _base(rng: Rng, height: float, radius: float) -> list[Manifold]:
    """Pedestal: column on a flange, cone, box, or a wide turntable."""
    style = rng.choice(["column", "cone", "box", "turntable"])
    wide = radius * rng.uniform(1.8, 2.8)
    top = (0, 0, height)
    neck = rod((0, 0, height * 0.5), top, radius * 1.15, segments=28)
    if style == "column":
        flange = lathe([(wide, 0), (wide, 0.03), (radius * 1.3, 0.05)])
        return [flange, rod((0, 0, 0.01), top, radius * 1.25, segments=28)]
    if style == "cone":
        return [rod((0, 0, 0), top, wide, radius * 1.1, 32)]
    tall = height * rng.uniform(0.5, 0.8)
    if style == "box":
        return [box((0, 0, tall / 2), (wide * 2, wide * 2, tall), 0.02), neck]
    plate = box((0, 0, 0.02), (wide * 2.2, wide * 2.2, 0.04))
    return [plate, rod((0, 0, 0.02), (0, 0, tall), wide * 0.9, segments=32), neck]


def _link(style: str, chain: Chain, index: int) -> list[Manifold]:
    """The joint's housing across the pitch axis, and the link's body."""
    hinge, start, end = (row[index] for row in chain[:3])
    frame, wide = chain.frames[index], chain.radii[index]
    axis, thin = frame[:, 0], chain.radii[min(index + 1, len(chain.radii) - 1)]
    step = (start - hinge) @ axis
    low, high = min(step, 0.0) - 1.2 * wide, max(step, 0.0) + 1.2 * wide
    housing = rod(hinge + low * axis, hinge + high * axis, 1.1 * wide, segments=24)
    if style == "tube":
        return [housing, rod(start, end, 0.8 * wide, 0.8 * thin, 24)]
    if style == "capsule":
        return [housing, capsule(start, end, wide, thin)]
    length = float(np.linalg.norm(end - start))
    if style == "box":
        rows = [
            (sx * size, sy * size, z)
            for size, z in ((0.8 * wide, 0), (0.8 * thin, length))
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
        return [housing, place(Manifold.hull_points(np.array(rows)), frame, start)]
    if style == "yoke":
        size = (0.5 * wide, 1.3 * wide, length)
        plates = [box((s * 0.85 * wide, 0, length / 2), size) for s in (-1, 1)]
        pin = rod(end - 1.1 * wide * axis, end + 1.1 * wide * axis, 0.65 * wide)
        return [housing, pin, *(place(plate, frame, start) for plate in plates)]
    ends = [
        rod(point - size * axis, point + size * axis, size, segments=20)
        for point, size in ((start, wide), (end, thin))
    ]
    return [housing, Manifold.batch_hull(ends)]


def _tool(rng: Rng, chain: Chain) -> list[Manifold]:
    """Two-finger or three-finger gripper, suction cup or welding torch."""
    wide = float(chain.radii[-1])
    style = rng.choice(["two", "three", "suction", "torch"], p=[0.5, 0.2, 0.15, 0.15])
    solids = [
        ball((0, 0, 0), 1.05 * wide, 18),
        rod((0, 0, 0), (0, 0, 1.6 * wide), 0.7 * wide),
    ]
    palm, long = 1.5 * wide, rng.uniform(0.1, 0.17)
    if style == "two":
        opening = rng.uniform(0.025, 0.07)
        solids.append(box((0, 0, palm + 0.02), (2 * opening + 0.07, 1.2 * wide, 0.05)))
        for side in (-1, 1):
            center = (side * (opening + 0.015), 0, palm + 0.02 + long / 2)
            solids.append(box(center, (0.028, 0.9 * wide, long)))
    elif style == "three":
        spread = rng.uniform(0.03, 0.08)
        solids.append(rod((0, 0, palm), (0, 0, palm + 0.04), 0.06))
        for angle in 2 * np.pi * np.arange(3) / 3:
            out = np.array((np.cos(angle), np.sin(angle), 0))
            knuckle = (0.045 + spread) * out + (0, 0, palm + 0.5 * long)
            tip = 0.6 * spread * out + (0, 0, palm + 1.1 * long)
            root = 0.045 * out + (0, 0, palm + 0.02)
            solids += [capsule(root, knuckle, 0.016), capsule(knuckle, tip, 0.014)]
    elif style == "suction":
        cup = palm + 0.5 * long
        solids.append(rod((0, 0, palm - 0.01), (0, 0, cup), 0.02))
        solids.append(rod((0, 0, cup - 0.005), (0, 0, cup + 0.05), 0.025, 0.07, 24))
    else:
        bend = (0, 0.02, palm + 0.6 * long)
        solids.append(capsule((0, 0, palm - 0.02), bend, 0.022))
        solids.append(capsule(bend, (0, 0.09, palm + 1.1 * long), 0.02, 0.01))
    return [place(solid, chain.frames[-1], chain.ends[-1]) for solid in solids]
