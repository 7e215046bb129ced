"""Random lines that solids are made from: closed outlines to extrude, profiles to turn
about an axis, and smooth paths to sweep along.

Outlines are simple polygons, counter-clockwise, that span the square of side 1 about
the origin.
"""

import numpy as np
from jaxtyping import Float64

from experiments.simulation.solids import Rng, axes_along

Outline = Float64[np.ndarray, "N 2"]


def outline(rng: Rng) -> Outline:
    """A regular or rounded polygon, a section as of rolled steel, a gear, a blob, an
    arch, a bent band or a quadrilateral."""
    kinds = (_regular, _rounded, _skyline, _gear, _blob, _arch, _band, _quadrilateral)
    weights = (0.15, 0.15, 0.25, 0.1, 0.07, 0.1, 0.08, 0.1)
    return spanned(kinds[rng.choice(len(kinds), p=weights)](rng))


def convex_outline(rng: Rng) -> Outline:
    """A regular polygon, a rounded rectangle, an arch or a quadrilateral."""
    kinds = (_regular, _rounded, _arch, _quadrilateral)
    return spanned(kinds[rng.choice(len(kinds))](rng))


def spanned(points: Float64[np.ndarray, "N 2"]) -> Outline:
    """Points moved and stretched until they span the square."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    return (points - (lower + upper) / 2) / (upper - lower)


def circle(count: int, start: float = 0.0) -> Outline:
    """A regular polygon in the circle of radius 1."""
    angle = start + 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _regular(rng: Rng) -> Outline:
    count = int(rng.choice([3, 5, 6, 8, 24]))
    return circle(count, rng.choice([0.0, np.pi / count]))


def _rounded(rng: Rng) -> Outline:
    """A superellipse, between an ellipse and a rectangle."""
    points = circle(24, np.pi / 24)
    return np.sign(points) * np.abs(points) ** (2 / rng.uniform(2.0, 8.0))


def _skyline(rng: Rng) -> Outline:
    """Columns of several heights: L, T, U, steps; mirrored at the floor, I and H."""
    heights = rng.uniform(0.15, 1.0, int(rng.integers(2, 4)))
    widths = rng.uniform(0.2, 1.0, len(heights))
    if rng.random() < 0.6:
        heights, widths = (np.append(a, a[-2::-1]) for a in (heights, widths))
    edges = np.append(0.0, np.cumsum(widths))
    roof = np.stack([np.repeat(edges, 2)[1:-1], np.repeat(heights, 2)], axis=1)[::-1]
    if rng.random() < 0.4:
        return np.concatenate([roof, (roof * (1, -1))[::-1]])
    return np.concatenate([roof, [[0.0, 0.0], [edges[-1], 0.0]]])


def _gear(rng: Rng) -> Outline:
    """Teeth or points around a circle."""
    teeth, inner = int(rng.integers(4, 11)), rng.uniform(0.45, 0.9)
    radii = [inner, inner, 1, 1] if rng.random() < 0.7 else [inner, 1]
    points = circle(teeth * len(radii), rng.uniform(0, 2 * np.pi))
    return points * np.tile(radii, teeth)[:, None]


def _blob(rng: Rng) -> Outline:
    """A smooth closed curve around the middle."""
    points = circle(28)
    angle, orders = np.arctan2(points[:, 1], points[:, 0]), np.arange(2, 5)
    sizes = rng.uniform(-0.5, 0.5, 3) / orders
    phases = rng.uniform(0, 2 * np.pi, 3) * (rng.random() < 0.5)
    waves = sizes * np.cos(angle[:, None] * orders + phases)
    return points * (1 + waves.sum(axis=1, keepdims=True))


def _arch(rng: Rng) -> Outline:
    """Half an ellipse over a rectangle."""
    top = circle(24)[:13] * (1, rng.uniform(0.3, 1.2))
    foot = -rng.uniform(0.0, 1.5) - 0.05
    return np.concatenate([top, [[-1.0, foot], [1.0, foot]]])


def _band(rng: Rng) -> Outline:
    """Part of a flat ring."""
    angle = np.linspace(0, rng.uniform(0.6, 1.7) * np.pi, 16)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([arc, rng.uniform(0.4, 0.85) * arc[::-1]])


def _quadrilateral(rng: Rng) -> Outline:
    """A trapezoid, a right one among them, or nearly a triangle."""
    left, right = rng.uniform(0.05, 0.9, 2) * rng.choice([(1, 1), (0, 1), (1, 0)])
    if rng.random() < 0.5:
        left = right
    return np.array([(0, 0), (2, 0), (2 - 0.95 * right, 1), (0.95 * left, 1)], float)


def profile(rng: Rng, knots: int | None = None) -> Float64[np.ndarray, "N 2"]:
    """(radius, z) pairs from z = 0 up to 1, the largest radius 1: stepped or smooth."""
    count = int(rng.integers(3, 6)) if knots is None else knots
    radii = np.exp(rng.uniform(np.log(0.2), 0.0, count))
    levels = np.append(0.0, np.cumsum(rng.uniform(0.2, 1.0, count)))
    levels /= levels[-1]
    if rng.random() < 0.5:
        line = np.stack([np.repeat(radii, 2), np.repeat(levels, 2)[1:-1]], axis=1)
    else:
        line = smooth(np.stack([radii, levels[:-1] / levels[-2]], axis=1), 2)
    return line / (line[:, 0].max(), 1.0)


def smooth(line: np.ndarray, times: int) -> np.ndarray:
    """Corners cut at quarters, again and again: towards a quadratic B-spline, ends
    kept. Source: G. Chaikin, An algorithm for high-speed curve generation, 1974."""
    for _ in range(times):
        first, second = line[:-1], line[1:]
        cut = np.stack([0.75 * first + 0.25 * second, 0.25 * first + 0.75 * second], 1)
        line = np.concatenate([line[:1], cut.reshape(-1, line.shape[1]), line[-1:]])
    return line


def path(rng: Rng) -> Float64[np.ndarray, "P 3"]:
    """A way whose box has its longest side 1, about the origin: with bends at right
    angles, an arc, a coil, a wave, or any smooth curve."""
    kinds = (_walk, _arc, _coil, _wave, _curve)
    line = kinds[rng.choice(len(kinds), p=(0.35, 0.3, 0.1, 0.1, 0.15))](rng)
    lower, upper = line.min(axis=0), line.max(axis=0)
    return (line - (lower + upper) / 2) / (upper - lower).max()


def _walk(rng: Rng) -> np.ndarray:
    """Straight legs along the axes, rounded where they meet; some rise and come down
    again, as handles do."""
    if rng.random() < 0.4:
        reach, lean = rng.uniform(0.4, 2.0), rng.choice([0.0, rng.uniform(-0.3, 0.3)])
        corners = [(0, 0, 0), (lean, 0, 1), (reach - lean, 0, 1), (reach, 0, 0)]
        return _rounded_legs(np.array(corners, float))
    corners, last = [np.zeros(3)], -1
    for _ in range(int(rng.integers(2, 5))):
        last = int(rng.choice([axis for axis in range(3) if axis != last]))
        step = np.eye(3)[last] * rng.uniform(0.4, 1.0) * rng.choice([-1, 1, 1, 1])
        corners.append(corners[-1] + step)
    return _rounded_legs(np.array(corners))


def _rounded_legs(corners: np.ndarray) -> np.ndarray:
    """Straight but for a bend at each corner, a quadratic curve."""
    share, line = np.linspace(0, 1, 7)[:, None], [corners[0]]
    for before, corner, after in zip(corners, corners[1:], corners[2:], strict=False):
        start, end = 0.65 * corner + 0.35 * before, 0.65 * corner + 0.35 * after
        first, second = (
            start + share * (corner - start),
            corner + share * (end - corner),
        )
        line += list(first + share * (second - first))
    return np.array([*line, corners[-1]])


def _arc(rng: Rng) -> np.ndarray:
    angle = np.linspace(0, rng.uniform(0.4, 1.7) * np.pi, 18)
    rise = rng.choice([0.0, rng.uniform(-1, 1)])
    return np.stack([np.cos(angle), rise * angle / 3, np.sin(angle)], axis=1)


def _coil(rng: Rng) -> np.ndarray:
    turns = rng.uniform(1.5, 4.0)
    angle = np.linspace(0, turns * 2 * np.pi, int(14 * turns))
    shrink = 1 - rng.choice([0.0, rng.uniform(0.0, 0.6)]) * angle / angle[-1]
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * shrink[:, None]
    return np.column_stack([ring, rng.uniform(0.15, 0.5) * angle])


def _wave(rng: Rng) -> np.ndarray:
    bends = int(rng.integers(2, 6))
    along = np.linspace(0, 1, 1 + 8 * bends)
    height = np.sin(along * np.pi * bends) * rng.uniform(0.2, 0.5) / bends
    return np.stack([along, 0 * along, height], axis=1)


def _curve(rng: Rng) -> np.ndarray:
    steps = rng.normal(size=(int(rng.integers(3, 6)), 3)) + (1.5, 0, 0)
    return smooth(np.cumsum(steps, axis=0) @ axes_along(rng.normal(size=3)), 3)


def tightest_bend(line: Float64[np.ndarray, "P 3"]) -> float:
    """The smallest radius of curvature at the points of a way; infinite if straight."""
    steps = np.diff(line, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    cosines = np.sum(steps[1:] * steps[:-1], axis=1) / (lengths[1:] * lengths[:-1])
    turns = np.arccos(np.clip(cosines, -1, 1))
    reach = np.minimum(lengths[1:], lengths[:-1])
    return float(np.min(reach / np.maximum(turns, 1e-9), initial=np.inf))
