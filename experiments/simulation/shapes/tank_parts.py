"""Nozzles, manholes and ladders of procedural tanks; and hoppers, a kind of them."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.shapes.valves import flange, hand_wheel
from experiments.simulation.solids import (
    Rng,
    Solids,
    bar,
    box,
    corners,
    lathe,
    rod,
    torus,
    tube_along,
)


def nozzle(
    rng: Rng, root: np.ndarray, out: np.ndarray, size: float, reach: float
) -> Solids:
    """A short pipe with a flange at its end, blind, open, or with a hand wheel."""
    end, count = root + reach * out, int(rng.choice([0, 4, 6]))
    bore = 0.7 * size * (rng.random() < 0.5)
    solids = [rod(root - 0.5 * reach * out, end - 0.4 * size * out, size, segments=14)]
    solids += flange(end - 0.5 * size * out, out, 1.9 * size, 0.5 * size, count, bore)
    return solids


def manhole(root: np.ndarray, out: np.ndarray, size: float) -> Solids:
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


def rungs(angle: float, radius: float, low: float, high: float, caged: bool) -> Solids:
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


def hopper(rng: Rng) -> Solids:
    """A round or square bin with a tapered outlet, in a frame of four posts."""
    half, tall = rng.uniform(0.4, 0.6), rng.uniform(0.5, 1.1)
    taper, mouth = rng.uniform(0.6, 1.0) * half * 1.3, rng.uniform(0.06, 0.12)
    free, is_round = taper + rng.uniform(0.25, 0.6), rng.random() < 0.5
    if is_round:
        profile = [(mouth, -taper), (half, 0), (half, tall), (0.96 * half, tall + 0.02)]
        shell, rim = lathe(profile, 36), torus(half, 0.025, segments=36, around=6)
        solids = [shell, rim, rim.translate((0, 0, tall))]
    else:
        low = [p + (0, 0, -taper) for p in corners(mouth, mouth)]
        cone = Manifold.hull_points(np.array(low + corners(half, half)))
        solids = [cone, box((0, 0, tall / 2), (2 * half, 2 * half, tall))]
        for level in (0.0, tall - 0.03):
            solids.append(box((0, 0, level), (2.1 * half, 2.1 * half, 0.05)))
    if rng.random() < 0.55:
        inner = 0.93 * half
        if is_round:
            solids.append(
                rod((0, 0, 0.15 * tall), (0, 0, 2 * tall), inner, segments=36)
            )
        else:
            solids.append(box((0, 0, 1.15 * tall), (2 * inner, 2 * inner, 2 * tall)))
        cavity = solids.pop()
        solids = [solid - cavity for solid in solids]
    else:
        up = np.array((0, 0, 1.0))
        for x in (-0.4 * half, 0.4 * half):
            spot = np.array((x, 0.0, tall))
            solids += nozzle(rng, spot, up, rng.uniform(0.05, 0.09), 0.16)
    gate = rng.uniform(1.3, 1.8) * mouth
    solids.append(rod((0, 0, -taper - 0.12), (0, 0, -taper + 0.02), mouth, segments=18))
    solids.append(box((0, 0.1, -taper - 0.05), (2 * gate, 2 * gate + 0.2, 0.035)))
    if rng.random() < 0.5:
        wheel = hand_wheel(rng, 0.1, 0.0)
        point = (0, gate + 0.28, -taper - 0.05)
        end = np.add(point, (0, 0.05, 0))
        solids += [part.rotate((90, 0, 0)).translate(point) for part in wheel]
        solids.append(rod((0, 0.1, point[2]), end, 0.015))
    solids = [solid.translate((0, 0, free)) for solid in solids]
    post, top = rng.uniform(0.06, 0.09), free + rng.uniform(0.05, 0.6) * tall
    reach = half * (1.02 if is_round else 1.0) + post / 2
    for spot in corners(reach, reach):
        solids.append(bar(spot, spot + (0, 0, top), post, post))
        solids.append(box(spot + (0, 0, 0.012), (2 * post, 2 * post, 0.024)))
    for level in (top - post, 0.3 * free) if rng.random() < 0.6 else (top - post,):
        for side in (-reach, reach):
            solids.append(box((0, side, level), (2 * reach, post, post)))
            solids.append(box((side, 0, level), (post, 2 * reach, post)))
    if is_round:
        for angle in (0, 90):
            cleat = bar(
                (-reach, 0, top - post), (reach, 0, top - post), 0.5 * post, post
            )
            solids.append(cleat.rotate((0, 0, angle)))
    return solids
