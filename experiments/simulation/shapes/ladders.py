"""Procedural ladders and steps, climbed from the front."""

from typing import NamedTuple

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import (
    assembled,
    bar,
    box,
    capsule,
    corners,
    one_of,
    rod,
    sweep,
    tube_along,
)

Rng = np.random.Generator
RUNG = 0.28  # metres between rungs, more or less


class Flight(NamedTuple):
    """Two stiles: the middle between their feet and between their heads, and half the
    distance between them below and above."""

    foot: np.ndarray
    head: np.ndarray
    half_foot: float
    half_head: float

    def at(self, share: float) -> tuple[np.ndarray, float]:
        """The middle and half the distance at a share of the way up."""
        half = self.half_foot + share * (self.half_head - self.half_foot)
        return self.foot + share * (self.head - self.foot), half


def ladder(rng: Rng) -> list[Manifold]:
    """Step ladders, plain and extending ladders, steps to a platform, step stools."""
    makers = _folding, _plain, _platform, _stool
    return assembled(one_of(rng, makers, (0.36, 0.2, 0.26, 0.18)))


def _stiles(flight: Flight, wide: float, deep: float, is_round: bool) -> list[Manifold]:
    solids = []
    for side in (-1, 1):
        start = flight.foot + (side * flight.half_foot, 0, 0)
        end = flight.head + (side * flight.half_head, 0, 0)
        if is_round:
            solids.append(rod(start, end, wide / 2, segments=12))
        else:
            solids.append(bar(start, end, wide, deep))
    return solids


def _rungs(
    flight: Flight, shares: np.ndarray, deep: float, thick: float, is_round: bool
) -> list[Manifold]:
    """Rungs or level treads between the stiles at shares of the way up."""
    solids = []
    for share in shares:
        middle, half = flight.at(float(share))
        if is_round:
            ends = middle - (half, 0, 0), middle + (half, 0, 0)
            solids.append(rod(*ends, thick / 2, segments=12))
        else:
            solids.append(box(middle, (2 * half, deep, thick)))
    return solids


def _shoes(flight: Flight, wide: float, deep: float) -> list[Manifold]:
    size = (1.5 * wide, 1.3 * deep, 0.05)
    sides = (-flight.half_foot, flight.half_foot)
    return [box(flight.foot + (x, 0, 0.01), size) for x in sides]


def _folding(rng: Rng) -> list[Manifold]:
    """Treads in front, legs behind, a cap, a tray or a hoop on top."""
    count = int(rng.integers(3, 9))
    tall = count * RUNG * rng.uniform(0.85, 1.0)
    half, flare = rng.uniform(0.17, 0.24), rng.uniform(1.0, 1.5)
    spread = tall * rng.uniform(0.22, 0.34)
    wide, deep = rng.uniform(0.025, 0.035), rng.uniform(0.05, 0.09)
    is_round, top = rng.random() < 0.25, np.array((0.0, 0.0, tall))
    front = Flight(np.array((0.0, spread, 0.0)), top, flare * half, half)
    shares, tread = (np.arange(count - 1) + 1) / count, rng.uniform(0.08, 0.14)
    solids = [*_stiles(front, wide, deep, is_round), *_shoes(front, wide, deep)]
    solids += _rungs(front, shares, tread, 0.03, False)
    behind = np.array((0.0, -spread * rng.uniform(0.8, 1.2), 0.0))
    back = Flight(behind, top - (0, 0.03, 0.04), flare * half * 0.95, half * 0.95)
    solids += [*_stiles(back, wide, wide, is_round), *_shoes(back, wide, wide)]
    if rng.random() < 0.25:  # to be climbed on both sides
        solids += _rungs(back, shares, tread, 0.03, False)
    else:
        levels = np.linspace(0.12, 0.85, int(rng.integers(2, 5)))
        solids += _rungs(back, levels, 0.02, 0.025, True)
    solids.append(box(top, (2 * half + 0.06, rng.uniform(0.12, 0.28), 0.05), 0.01))
    solids += _spreaders(front, back, rng.uniform(0.3, 0.6))
    if rng.random() < 0.45:
        solids.append(_hoop(half, tall - 0.02, rng.uniform(0.35, 0.65), 0.014))
    return solids


def _spreaders(front: Flight, back: Flight, share: float) -> list[Manifold]:
    (first, half), (second, other) = front.at(share), back.at(share)
    return [
        bar(first + (side * half, 0, 0), second + (side * other, 0, 0), 0.012, 0.022)
        for side in (-1, 1)
    ]


def _hoop(half: float, low: float, tall: float, radius: float) -> Manifold:
    """A bent tube in the x, z plane, from one stile up and down to the other."""
    rounding, arc = min(0.1, 0.6 * half), np.linspace(0, np.pi / 2, 6)
    turn = rounding * np.stack([1 - np.cos(arc), np.sin(arc)], axis=1)
    rise = np.array((-half, low + tall - rounding)) + turn
    line = np.concatenate([[(-half, low)], rise, (rise * (-1, 1))[::-1], [(half, low)]])
    path = np.column_stack([line[:, 0], np.zeros(len(line)), line[:, 1]])
    angle = 2 * np.pi * np.arange(10) / 10
    return sweep(path, radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _plain(rng: Rng) -> list[Manifold]:
    """A leaning ladder of one length, or of two that slide on each other."""
    count = int(rng.integers(6, 11))
    long, lean = count * RUNG, np.radians(rng.uniform(62, 80))
    along = np.array((0.0, -np.cos(lean), np.sin(lean)))
    half, flare = rng.uniform(0.17, 0.23), rng.uniform(1.0, 1.35)
    wide, deep = rng.uniform(0.025, 0.035), rng.uniform(0.06, 0.09)
    is_round, foot = rng.random() < 0.7, np.array((0.0, long * np.cos(lean) / 2, 0.0))
    flight = Flight(foot, foot + long * along, flare * half, half)
    shares = (np.arange(count) + 0.5) / count
    solids = [*_stiles(flight, wide, deep, False), *_shoes(flight, wide, deep)]
    solids += _rungs(flight, shares, 0.08, 0.032, is_round)
    if rng.random() < 0.4:
        start = rng.uniform(0.15, 0.6) * long
        lift = 0.9 * deep * np.array((0.0, np.sin(lean), np.cos(lean)))
        base = foot + start * along - lift
        other = Flight(base, base + long * along, 0.88 * half, 0.88 * half)
        solids += _stiles(other, wide, deep, False)
        solids += _rungs(other, shares, 0.08, 0.032, is_round)
        for level in (start + 0.1, long - 0.05):
            middle, reach = flight.at(level / long)
            solids.append(box(middle - 0.5 * lift, (2.1 * reach, 1.6 * deep, 0.05)))
    if rng.random() < 0.5:
        bottom = foot + (0, 0, 0.06)
        size = (2 * flare * half + rng.uniform(0.1, 0.4), 0.07, 0.05)
        solids.append(box(bottom, size))
    return solids


def _platform(rng: Rng) -> list[Manifold]:
    """Steps with handrails up to a platform on legs, on castors in some."""
    count = int(rng.integers(3, 8))
    tall, half = count * rng.uniform(0.2, 0.24), rng.uniform(0.24, 0.36)
    deep, run = rng.uniform(0.35, 0.6), tall / np.tan(np.radians(rng.uniform(48, 65)))
    edge, tube = deep / 2, rng.uniform(0.018, 0.024)
    head = np.array((0.0, edge, tall - 0.03))
    flight = Flight(head + (0, run, 0.03 - tall), head, half, half)
    shares = (np.arange(count - 1) + 1) / count
    solids = _stiles(flight, 0.03, 0.09, False)
    solids += _rungs(flight, shares, rng.uniform(0.14, 0.22), 0.03, False)
    solids.append(box((0, 0, tall), (2 * half + 0.04, deep + 0.03, 0.04)))
    posts = [spot * (1, 0.95, 1) for spot in corners(half, edge)]
    solids += [rod(spot, spot + (0, 0, tall), tube, segments=12) for spot in posts]
    for level in (0.12, 0.55) if rng.random() < 0.7 else (0.12,):
        for first, second in ((0, 1), (0, 2), (1, 3), (2, 3)):
            if (first, second) != (1, 3) or level < 0.3:
                start, end = (posts[k] + (0, 0, level * tall) for k in (first, second))
                solids.append(rod(start, end, 0.8 * tube, segments=10))
    if rng.random() < 0.8:
        solids += _handrails(rng, flight, half, edge, tall, tube)
    if rng.random() < 0.6:
        for spot in (*posts[:1], *posts[2:3]):
            center = spot + (0, 0, 0.04)
            ends = center - (0.03, 0, 0), center + (0.03, 0, 0)
            solids.append(rod(*ends, 0.08, segments=18))
    return solids


def _handrails(
    rng: Rng, flight: Flight, half: float, edge: float, tall: float, tube: float
) -> list[Manifold]:
    """Rails beside the steps and around the platform but for its front."""
    high, solids = rng.uniform(0.75, 1.0), []
    for level in (high, 0.5 * high):
        back = [np.array((x, -edge, tall + level)) for x in (-half, half)]
        front = [point + (0, 2 * edge, 0) for point in back]
        solids += tube_along(np.array([front[0], *back, front[1]]), tube, 10)
    for side in (-1, 1):
        x = side * half
        for y in (-edge, edge):
            low = np.array((x, y, tall - 0.02))
            solids.append(rod(low, low + (0, 0, high + 0.02), tube, segments=10))
        bottom, _ = flight.at(0.15)
        start = bottom + (x, 0, 0)
        line = [start, start + (0, 0, high), np.array((x, edge, tall + high))]
        solids += tube_along(np.array(line), tube, 10)
    return solids


def _stool(rng: Rng) -> list[Manifold]:
    """Two or three deep steps between panels, on tubes, or as solid blocks."""
    count, half = int(rng.integers(2, 4)), rng.uniform(0.18, 0.26)
    rise, run = rng.uniform(0.18, 0.25), rng.uniform(0.18, 0.26)
    style, solids = str(rng.choice(["panels", "tubes", "blocks"])), []
    for step in range(count):
        level, y = rise * (step + 1), run * ((count - 1) / 2 - step)
        size = (2 * half, run * 1.05, 0.03)
        solids.append(box((0, y, level - 0.015), size, 0.006))
        if style == "blocks":
            solids.append(box((0, y, level / 2), (1.94 * half, run, level - 0.02)))
        elif style == "panels":
            for x in (-half, half):
                size = (0.025, 0.98 * run, level)
                solids.append(box((x, y, level / 2), size))
        else:
            front = y + 0.4 * run
            for x in (-0.92 * half, 0.92 * half):
                foot, top = (x, front, 0), (x, front, level - 0.02)
                solids.append(rod(foot, top, 0.014, segments=10))
    back = -run * count / 2 + 0.02
    for x in (-0.92 * half, 0.92 * half):
        if style == "tubes":
            low = np.array((x, back, 0.0))
            solids.append(rod(low, low + (0, 0, rise * count - 0.02), 0.014))
            foot = np.array((x, run * count / 2 - 0.1 * run, 0.02))
            solids.append(capsule(low + (0, 0, 0.02), foot, 0.014))
    if style != "blocks" and rng.random() < 0.4:
        shift = (0, back, 0)
        hoop = _hoop(0.92 * half, rise * count - 0.03, rng.uniform(0.3, 0.6), 0.014)
        solids.append(hoop.translate(shift))
    if style == "panels" and rng.random() < 0.5:
        solids.append(box((0, back, rise * count / 2), (2 * half, 0.02, 0.4 * rise)))
    return solids
