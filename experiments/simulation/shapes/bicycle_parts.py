"""Parts of procedural bicycles: wheels, mudguards, the drive and the carrier."""

import numpy as np
from manifold3d import CrossSection, Manifold

from experiments.simulation.solids import bar, box, capsule, ring_of, rod, sweep, torus

Rng = np.random.Generator


def wheel(rng: Rng, kind: str, radius: float, tyre: float) -> list[Manifold]:
    """Tyre, rim, hub and spokes about z: wires in two planes, wide arms, or a disc."""
    inner = radius - tyre
    solids = [torus(inner, tyre, segments=36, around=8)]
    rim = [(inner - 0.02, -0.6), (inner, -0.8), (inner, 0.8), (inner - 0.02, 0.6)]
    hub = rng.uniform(0.018, 0.03)
    solids += [
        CrossSection([np.array(rim) * (1, tyre)]).revolve(36),
        rod((0, 0, -0.058), (0, 0, 0.058), 0.5 * hub, segments=10),
        rod((0, 0, -0.035), (0, 0, 0.035), hub, segments=16),
    ]
    style = rng.random()
    if style < 0.75:
        count, wire = int(rng.choice([6, 8, 9])), 0.0028
        for side in (-1, 1):
            spoke = rod(
                (0.8 * hub, 0, side * 0.03), ((inner - 0.01), 0, 0), wire, segments=6
            )
            solids += ring_of(spoke, count, 90 * side / count)
    elif style < 0.92 or kind == "town":
        arm = bar((0.5 * hub, 0, 0), (inner - 0.01, 0, 0), 0.018, 0.04, 0.6)
        solids += ring_of(arm, int(rng.integers(3, 7)))
    else:
        solids.append(rod((0, 0, -0.008), (0, 0, 0.008), inner - 0.005, segments=36))
    return solids


def mudguard(axle: np.ndarray, wheel: float, tyre: float, long: bool) -> list[Manifold]:
    """A strip around the upper part of a wheel, held by two stays."""
    first, last = (0.05, 0.9) if long else (0.18, 0.95)
    angle = np.pi * np.linspace(first, last, 14)
    ring = np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    path = axle + (wheel + 0.012) * ring
    strip = np.array([(-1.7, -0.15), (1.7, -0.15), (1.7, 0.15), (-1.7, 0.15)])
    solids = [sweep(path, tyre * strip)]
    for x in (-1.5 * tyre, 1.5 * tyre):
        end, start = path[-2] + (x, 0, 0), axle + (np.sign(x) * 0.056, 0, 0)
        solids.append(rod(start, end, 0.004, segments=6))
    upper = path[7]
    return [*solids, rod(upper, upper + (0, 0, 0.03), 0.008, segments=8)]


def chain_drive(rng: Rng, bracket: np.ndarray, rear: np.ndarray) -> list[Manifold]:
    """Chain wheel, sprocket, chain or its case, cranks and pedals."""
    side, ring = np.array((0.05, 0, 0)), rng.uniform(0.06, 0.095)
    across = np.array((0.008, 0, 0))
    center, small = bracket + side, rear + side
    solids = [rod(center - across, center + across, ring, segments=28)]
    solids.append(rod(small - across, small + across, 0.42 * ring, segments=20))
    chain = [
        rod(point - across / 2, point + across / 2, size, segments=24)
        for point, size in ((center, 1.05 * ring), (small, 0.5 * ring))
    ]
    case = Manifold.batch_hull(chain)
    if rng.random() < 0.65:
        hole = [
            rod(point - side, point + side, size, segments=20)
            for point, size in ((center, 0.93 * ring), (small, 0.38 * ring))
        ]
        case -= Manifold.batch_hull(hole)
    solids += [case, rod(bracket - 1.4 * side, bracket + 1.4 * side, 0.014)]
    angle, long = rng.uniform(0, 2 * np.pi), 1.9 * ring
    crank = long * np.array((0.0, np.cos(angle), np.sin(angle)))
    crank[2] = max(crank[2], 0.05 - bracket[2]) if crank[2] < 0 else crank[2]
    for sign in (-1, 1):
        root = bracket + sign * 1.3 * side
        tip = root + sign * crank
        solids.append(capsule(root, tip, 0.013, 0.01, 10))
        solids.append(box(tip + (sign * 0.055, 0, 0), (0.1, 0.08, 0.025)))
    return solids


def carrier(
    rng: Rng, rear: np.ndarray, radius: float, seat: np.ndarray
) -> list[Manifold]:
    """Rods over the wheel about `rear`, held at its axle and at the seat tube."""
    long, solids = rng.uniform(0.32, 0.42), []
    middle = np.array((0.0, rear[1] - 0.04, rear[2] + radius + 0.05))
    for x in (-0.055, 0.0, 0.055):
        start = middle + (x, -long / 2, 0)
        solids.append(rod(start, start + (0, long, 0), 0.007, segments=8))
    for y in np.linspace(-0.48, 0.48, 4) * long:
        start = middle + (-0.055, y, 0)
        solids.append(rod(start, start + (0.11, 0, 0), 0.006, segments=8))
    for x in (-0.055, 0.055):
        foot, front = rear + (1.15 * x, 0, 0), middle + (x, long / 2, 0)
        solids.append(rod(foot, middle + (x, -0.1, 0), 0.007, segments=8))
        solids.append(rod(seat + (0.2 * x, 0, -0.05), front, 0.007, segments=8))
    return solids
