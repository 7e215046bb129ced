"""Procedural machine frames, and the beams that gantries borrow."""

import itertools

import numpy as np
from manifold3d import CrossSection, Manifold

from experiments.simulation.shapes.drives import motor
from experiments.simulation.solids import (
    Rng,
    Vector,
    assembled,
    axes_along,
    bar,
    box,
    place,
    rod,
)


def beam(start: Vector, end: Vector, size: float, kind: str = "square") -> Manifold:
    """Member from `start` to `end`: "square", "round", slotted "profile", or "channel",
    an I-beam whose web stands upright where the beam lies level."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    if kind == "round":
        return rod(start, end, size / 2, segments=12)
    if kind == "square":
        return bar(start, end, size, size)
    half, length = size / 2, float(np.linalg.norm(end - start))
    section = CrossSection.square((size, size), True)
    if kind == "channel":
        for side in (-1, 1):
            notch = CrossSection.square((size * 0.7, size * 0.7), True)
            section -= notch.translate((side * half * 1.1, 0.0))
    else:
        slot = CrossSection.square((0.26 * size, 0.36 * size), True)
        for quarter in range(4):
            section -= slot.translate((0.0, half)).rotate(90 * quarter)
    return place(section.extrude(length), axes_along(end - start), start)


def feet(rng: Rng, points: list[np.ndarray], size: float) -> list[Manifold]:
    """Under each point, at z = 0: levelling feet, castors, plates or nothing."""
    kind, solids = rng.choice(["levelling", "castor", "plate", "none"]), []
    for point in points:
        if kind == "levelling":
            solids.append(rod(point - (0, 0, 0.07), point, 0.18 * size, segments=8))
            pad = point - (0, 0, 0.08)
            solids.append(rod(pad, pad + (0, 0, 0.025), 0.6 * size, 0.35 * size, 14))
        elif kind == "castor":
            low = point - (0, 0, 0.09)
            wheel = rod(low - (0.018, 0, 0), low + (0.018, 0, 0), 0.05, segments=14)
            solids += [wheel, box(point - (0, 0, 0.045), (0.055, 0.05, 0.1))]
        elif kind == "plate":
            solids.append(box(point, (2.4 * size, 2.4 * size, 0.02)))
    return solids


def machine_frame(rng: Rng) -> list[Manifold]:
    """Uprights and rails in bays and levels, with braces, panels, gussets, plates:
    machine tables, racks, stepped frames, presses and cells."""
    kind = str(rng.choice(["square", "profile", "round", "channel"]))
    size, bays = rng.uniform(0.04, 0.08), int(rng.integers(1, 4))
    width, depth = rng.uniform(0.55, 0.9) * bays**0.7, rng.uniform(0.45, 0.9)
    low, top = rng.uniform(0.1, 0.25), rng.uniform(0.6, 0.9)
    high = top + rng.uniform(0.6, 1.1)
    styles = ["table", "rack", "step", "press", "cell"]
    style = str(rng.choice(styles, p=[0.14, 0.2, 0.22, 0.2, 0.24]))
    columns, y = np.linspace(-width / 2, width / 2, bays + 1), depth / 2
    levels = [low, top]
    if style == "rack":
        levels = list(np.linspace(low, high, int(rng.integers(3, 5))))
    if style == "cell":
        levels = [low, top, high]
    solids = _cage(columns, (-y, y), levels, size, kind)
    if style == "step":
        front = rng.uniform(-0.4, 0.2) * y
        solids += _cage(columns, (-y, front), [top, high], size, kind)
    elif style == "press":
        back, front = (-0.6 * y, 0.3 * y)
        solids += _cage(columns[[0, -1]], (back, front), [top, high], 1.3 * size, kind)
        solids += _ram(rng, (back + front) / 2, top, high, size)
    plates = [top] if style != "rack" else [z for z in levels if rng.random() < 0.5]
    for z in plates:
        thick, over = rng.uniform(0.015, 0.05), rng.choice([0.0, 0.04])
        slab = (width + size + 2 * over, depth + size + 2 * over, thick)
        if style in ("cell", "rack"):
            slab = (width, depth, thick)
        solids.append(box((0, 0, z + size / 2 + thick / 2 - 0.003), slab))
    solids += _infill(rng, columns, depth, levels, size, style == "cell")
    if plates:
        solids += _mounted(rng, width, depth, low, plates[-1] + size / 2, style)
    points = [np.array((x, s * y, 0.0)) for x in columns for s in (-1, 1)]
    return assembled(solids + feet(rng, points, size))


def _ram(rng: Rng, y: float, top: float, high: float, size: float) -> list[Manifold]:
    """A press's head between the portal's rails, its cylinder and its tool."""
    radius, low = rng.uniform(0.06, 0.11), top + rng.uniform(0.15, 0.3)
    head = box((0, y, high), (4 * radius, 1.0, 1.6 * size), 0.01)
    return [
        head.trim_by_plane((0, 1, 0), y - 0.3).trim_by_plane((0, -1, 0), -y - 0.3),
        rod((0, y, high - 0.25), (0, y, high + 0.25), radius, segments=20),
        rod((0, y, low), (0, y, high), 0.45 * radius, segments=14),
        box((0, y, low), (4 * radius, 3 * radius, 0.06), 0.008),
        box((0, y, top + 0.1), (3 * radius, 3 * radius, 0.14), 0.008),
    ]


def _cage(
    columns: np.ndarray,
    rows: tuple[float, float],
    levels: list[float],
    size: float,
    kind: str,
) -> list[Manifold]:
    """Uprights on the grid of columns and rows, rails around it at every level."""
    solids, bottom = [], 0.0 if levels[0] < 0.4 else levels[0]
    for x, y in itertools.product(columns, dict.fromkeys(rows)):
        solids.append(beam((x, y, bottom), (x, y, levels[-1] + size / 2), size, kind))
    for z in levels:
        for y in dict.fromkeys(rows):
            solids.append(beam((columns[0], y, z), (columns[-1], y, z), size, kind))
        if rows[0] != rows[1]:
            for x in columns:
                solids.append(beam((x, rows[0], z), (x, rows[1], z), size, kind))
    return solids


def _infill(
    rng: Rng,
    columns: np.ndarray,
    depth: float,
    levels: list[float],
    size: float,
    is_cell: bool,
) -> list[Manifold]:
    """In each field of the cage a brace, a cross, a panel, gussets, or nothing; walls
    around the upper level of a cell but for its front."""
    solids, y = [], depth / 2
    usual = str(rng.choice(["brace", "cross", "panel", "gusset"]))
    share, spans = rng.choice([0.0, 0.4, 0.8]), list(itertools.pairwise(levels))
    fields = [
        ((left, side, low), (right, side, high))
        for side in (-y, y)
        for left, right in itertools.pairwise(columns)
        for low, high in spans
    ]
    fields += [
        ((side, -y, low), (side, y, high))
        for side in (columns[0], columns[-1])
        for low, high in spans
    ]
    if is_cell:
        roof = ((columns[0], -y, levels[-1]), (columns[-1], y, levels[-1]))
        fields += [roof] if rng.random() < 0.6 else []
    for first, last in fields:
        start, end = np.array(first), np.array(last)
        if is_cell and end[2] == levels[-1]:
            is_front = start[1] == end[1] == y
            if not is_front or rng.random() < 0.25:
                solids.append(_panel(start, end))
        elif rng.random() < share:
            solids += _field(rng, usual, start, end, size)
    return solids


def _panel(start: np.ndarray, end: np.ndarray) -> Manifold:
    return box((start + end) / 2, np.where(end == start, 0.012, end - start))


def _field(
    rng: Rng, fill: str, start: np.ndarray, end: np.ndarray, size: float
) -> list[Manifold]:
    if fill == "panel":
        return [_panel(start, end)]
    if fill == "gusset":
        along = (end - start) * (1, 1, 0)
        along /= np.linalg.norm(along)
        solids, up, leg = [], np.array((0, 0, 1.0)), 0.5 * size + 0.14
        thin = np.cross(along, up) * 0.012
        for corner, turn in (((*start[:2], end[2]), 1), (end, -1)):
            tips = [np.array(corner), corner + turn * leg * along, corner - leg * up]
            both = [tip + s * thin for tip in tips for s in (-1, 1)]
            solids.append(Manifold.hull_points(np.array(both)))
        return solids
    ends = [(start, end), ((*end[:2], start[2]), (*start[:2], end[2]))]
    if fill == "brace":
        ends = [ends[rng.integers(2)]]
    return [bar(low, high, 0.55 * size, 0.55 * size) for low, high in ends]


def _mounted(
    rng: Rng, width: float, depth: float, low: float, top: float, style: str
) -> list[Manifold]:
    """A shelf with a box or a tank below; a motor, a turntable or a box on the table;
    a control panel on an arm."""
    solids = []
    if rng.random() < 0.5:
        room, x = top - low - 0.1, rng.uniform(-0.2, 0.2) * width
        solids.append(box((0, 0, low + 0.02), (width, depth, 0.025)))
        if rng.random() < 0.5:
            size = (0.4 * width, 0.6 * depth, room * rng.uniform(0.4, 0.9))
            solids.append(box((x, 0, low + 0.02 + size[2] / 2), size, 0.01))
        else:
            radius = 0.26 * min(depth, width)
            tank = rod((x, 0, low), (x, 0, low + 0.8 * room), radius)
            solids += [tank, rod((x, 0, low), (x, 0, low + 0.88 * room), radius * 0.3)]
    kind = rng.choice(["none", "motor", "turntable", "box"])
    x, size = rng.uniform(-0.25, 0.25) * width, rng.uniform(0.1, 0.24, 3)
    if style != "press" and kind == "motor":
        radius = 0.5 * float(size[0])
        drive = [part.rotate((0, 90, 0)) for part in motor(rng, radius, 3 * radius)]
        drive.append(box((1.5 * radius, 0, -radius), (2 * radius, 2 * radius, 0.06)))
        solids += [part.translate((x, 0, top + radius)) for part in drive]
    elif style != "press" and kind == "turntable":
        wide = 0.3 * min(width, depth)
        for radius, height in ((wide * 0.7, 0.1), (wide, 0.14), (wide * 0.2, 0.24)):
            solids.append(rod((x, 0, top), (x, 0, top + height), radius, segments=28))
    elif style != "press" and kind == "box":
        solids.append(box((x, 0, top + size[2] / 2), size, 0.008))
    if rng.random() < 0.3 and style in ("table", "press", "step"):
        corner = np.array((width / 2, depth / 2, top - 0.02))
        knee = corner + (0, 0, 0.4)
        solids += [rod(corner, knee, 0.02, segments=10)]
        solids += [rod(knee - (0, 0, 0.01), knee + (0.1, 0.1, 0), 0.02, segments=10)]
        solids.append(box(knee + (0.1, 0.1, 0), (0.28, 0.07, 0.2), 0.01))
    return solids
