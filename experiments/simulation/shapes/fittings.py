"""What is fitted to procedural tanks: nozzles, manholes and ladders."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.shapes.valves import flange
from experiments.simulation.solids import bar, rod, tube_along

Rng = np.random.Generator


def nozzle(
    rng: Rng, root: np.ndarray, out: np.ndarray, size: float, reach: float
) -> list[Manifold]:
    """A short pipe with a flange at its end, blind, open, or with a hand wheel."""
    end, count = root + reach * out, int(rng.choice([0, 4, 6]))
    bore = 0.7 * size * (rng.random() < 0.5)
    solids = [rod(root - 0.5 * reach * out, end - 0.4 * size * out, size, segments=14)]
    solids += flange(end - 0.5 * size * out, out, 1.9 * size, 0.5 * size, count, bore)
    return solids


def manhole(root: np.ndarray, out: np.ndarray, size: float) -> list[Manifold]:
    """A wide bolted cover on a short neck, with a handle."""
    solids = [rod(root - 0.5 * size * out, root + 0.35 * size * out, 0.8 * size)]
    solids += flange(root + 0.3 * size * out, out, size, 0.12 * size, 10)
    solids += flange(root + 0.4 * size * out, out, size, 0.1 * size)
    grip = root + 0.62 * size * out
    side = np.cross(out, (0, 0, 1.0) if abs(out[2]) < 0.9 else (1.0, 0, 0))
    ends = grip - 0.35 * size * side, grip + 0.35 * size * side
    solids.append(rod(*ends, 0.05 * size, segments=8))
    for point in ends:
        solids.append(rod(point - 0.25 * size * out, point, 0.05 * size, segments=8))
    return solids


def around(angle: float, radius: float, level: float) -> tuple[np.ndarray, np.ndarray]:
    """A point on a cylinder about z, and the direction out there; 0 is the front."""
    out = np.array((np.sin(angle), np.cos(angle), 0.0))
    return radius * out + (0, 0, level), out


def rungs(
    angle: float, radius: float, low: float, high: float, caged: bool
) -> list[Manifold]:
    """A ladder up the side of a cylinder about z, in a cage in some."""
    wide, gap = 0.16, 0.1
    _, out = around(angle, 1.0, 0.0)
    side = np.array((out[1], -out[0], 0.0))
    base, solids = (radius + gap) * out, []
    for sign in (-1, 1):
        foot = base + sign * wide * side
        solids.append(bar(foot + (0, 0, low), foot + (0, 0, high), 0.03, 0.03))
        for level in np.linspace(low + 0.15, high - 0.15, 3):
            point = foot + (0, 0, level)
            solids.append(bar(point, point - 1.6 * gap * out, 0.025, 0.025))
    for level in np.arange(low + 0.2, high - 0.05, 0.27):
        start, reach = base + (0, 0, level), wide * side
        solids.append(rod(start - reach, start + reach, 0.013, segments=8))
    if caged and high - low > 1.5:
        arc, ring = np.linspace(-0.5, 0.5, 7) * 1.3 * np.pi, base + 0.26 * out
        points = [ring + 0.3 * (np.cos(a) * out + np.sin(a) * side) for a in arc]
        for level in np.linspace(low + 1.1, high, 4):
            stiles = base - wide * side, base + wide * side
            hoop = np.array([stiles[0], *points, stiles[1]]) + (0, 0, level)
            solids += tube_along(hoop, 0.014, 6)
        for point in points[1:-1:2]:
            start = point + (0, 0, low + 1.1)
            solids.append(rod(start, point + (0, 0, high), 0.012, segments=6))
    return solids
