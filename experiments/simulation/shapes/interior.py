"""Procedural sofas, cabinets and lamps."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import ball, bar, box, lathe, rod, tube_along, union

Rng = np.random.Generator


def sofa(rng: Rng) -> list[Manifold]:
    """One to four seats, straight or with a chaise, arms and cushions in styles."""
    seats = int(rng.integers(1, 5))
    arm = rng.uniform(0.1, 0.24) if rng.random() < 0.88 else 0.0
    seat_width, depth = rng.uniform(0.5, 0.68), rng.uniform(0.75, 0.95)
    inner = seats * seat_width
    width = inner + 2 * arm
    foot, base = rng.uniform(0.04, 0.15), rng.uniform(0.14, 0.25)
    back_height, back = rng.uniform(0.62, 0.95), rng.uniform(0.14, 0.24)
    soft, middle = rng.uniform(0.01, 0.05), foot + base / 2
    solids = [box((0, 0, middle), (width, depth, base), soft / 2)]
    center = (0, -depth / 2 + back / 2, (foot + back_height) / 2)
    solids.append(box(center, (width, back, back_height - foot), soft))
    if arm:
        solids += _sofa_arms(rng, arm, width, depth, foot, back_height, soft)
    chaise = rng.choice([-1, 0, 1], p=[0.17, 0.66, 0.17]) if seats > 1 else 0
    reach = depth * rng.uniform(0.45, 0.8)
    if chaise:
        x = chaise * (inner - seat_width) / 2
        center = (x, depth / 2 + reach / 2 - 0.02, middle)
        solids.append(box(center, (seat_width, reach + 0.04, base), soft / 2))
    cushion = rng.uniform(0.1, 0.18)
    seat_depth, level = depth - back, foot + base + cushion / 2 - 0.015
    for index in range(seats):
        x = (index + 0.5) * seat_width - inner / 2
        extra = reach if chaise and index == (0 if chaise < 0 else seats - 1) else 0
        y = back / 2 + 0.01 + extra / 2
        size = (seat_width * 0.985, seat_depth + 0.02 + extra, cushion)
        solids.append(box((x, y, level), size, soft * 1.2))
    if rng.random() < 0.6:
        solids += _back_cushions(rng, seats, seat_width, level + 0.02, depth, back)
    for x in (-width / 2 + 0.08, width / 2 - 0.08):
        for y in (-depth / 2 + 0.08, depth / 2 - 0.08):
            solids.append(rod((x, y, 0), (x, y, foot + 0.02), 0.025, 0.04, 12))
    return solids


def _sofa_arms(
    rng: Rng,
    arm: float,
    width: float,
    depth: float,
    foot: float,
    back_height: float,
    soft: float,
) -> list[Manifold]:
    """Box-shaped, or with a roll on top."""
    height, solids = rng.uniform(0.48, min(0.7, back_height)), []
    rolled = rng.random() < 0.35
    for x in (-(width - arm) / 2, (width - arm) / 2):
        center = (x, 0, (foot + height) / 2)
        solids.append(box(center, (arm, depth, height - foot), soft))
        if rolled:
            back, front = (x, -depth / 2 + 0.02, height), (x, depth / 2, height)
            solids.append(rod(back, front, arm * 0.62))
    return solids


def _back_cushions(
    rng: Rng, seats: int, seat_width: float, low: float, depth: float, back: float
) -> list[Manifold]:
    tall, thick = rng.uniform(0.3, 0.45), rng.uniform(0.12, 0.2)
    lean, solids = rng.uniform(5, 18), []
    for index in range(seats):
        x = (index + 0.5) * seat_width - seats * seat_width / 2
        pillow = box((0, 0, tall / 2), (seat_width * 0.94, thick, tall), thick * 0.3)
        pillow = pillow.rotate((lean, 0, 0))
        solids.append(pillow.translate((x, -depth / 2 + back + thick * 0.45, low)))
    return solids


def cabinet(rng: Rng) -> list[Manifold]:
    """A carcass on feet or a plinth with a grid of doors, drawers and open cells."""
    width, depth = rng.uniform(0.5, 1.6), rng.uniform(0.3, 0.6)
    height = rng.uniform(0.5, 1.9)
    foot = rng.choice([0.0, rng.uniform(0.05, 0.25)], p=[0.3, 0.7])
    columns = max(1, round(width / rng.uniform(0.35, 0.7)))
    rows = max(1, round((height - foot) / rng.uniform(0.25, 0.9)))
    body = box((0, 0, (foot + height) / 2), (width, depth, height - foot))
    open_share = rng.choice([0.0, 0.3, 1.0], p=[0.5, 0.35, 0.15])
    handle, relief = rng.choice(["knob", "bar", "none"]), rng.uniform(0.015, 0.03)
    wall, fronts, cells = rng.uniform(0.02, 0.04), [], []
    cell = (width - wall) / columns, (height - foot - wall) / rows
    for column in range(columns):
        for row in range(rows):
            x = -width / 2 + wall / 2 + (column + 0.5) * cell[0]
            z = foot + wall / 2 + (row + 0.5) * cell[1]
            if rng.random() < open_share:
                size = (cell[0] - wall, depth, cell[1] - wall)
                cells.append(box((x, wall, z), size))
                continue
            size = (cell[0] - wall * 0.7, relief * 2, cell[1] - wall * 0.7)
            fronts.append(box((x, depth / 2, z), size))
            fronts += _handle(handle, x, depth / 2 + relief, z, cell, column % 2)
    carcass = body - union(cells) if cells else body
    solids = [carcass, *fronts, *_feet(rng, width, depth, foot)]
    if rng.random() < 0.4:
        over = rng.uniform(0.01, 0.05)
        size = (width + 2 * over, depth + 2 * over, 0.04)
        solids.append(box((0, 0, height), size))
    return solids


def _handle(
    kind: str, x: float, y: float, z: float, cell: tuple[float, float], left: int
) -> list[Manifold]:
    """A handle in the middle of a drawer, or at the inner edge of a tall door."""
    is_door = cell[1] > cell[0]
    if is_door:
        x += (0.5 - left) * cell[0] * 0.7
    if kind == "knob":
        return [rod((x, y - 0.005, z), (x, y + 0.035, z), 0.016, 0.022, 12)]
    if kind == "bar":
        along = np.array((0, 0, 0.1) if is_door else (min(0.12, cell[0] / 4), 0, 0))
        center = np.array((x, y + 0.03, z))
        ends = [center - along, center + along]
        posts = [rod(end - (0, 0.04, 0), end, 0.008, segments=8) for end in ends]
        return [rod(ends[0] * 1.0, ends[1], 0.01, segments=10), *posts]
    return []


def _feet(rng: Rng, width: float, depth: float, foot: float) -> list[Manifold]:
    if foot == 0:
        return []
    if rng.random() < 0.3:
        size = (width * 0.94, depth * 0.9, foot + 0.02)
        return [box((0, 0, size[2] / 2), size)]
    thick, lean = rng.uniform(0.03, 0.06), rng.choice([1.0, 1.1])
    solids = []
    for sx in (-1, 1):
        for sy in (-1, 1):
            head = np.array(
                (sx * (width / 2 - thick), sy * (depth / 2 - thick), foot + 0.01)
            )
            solids.append(bar(head, head * (lean, lean, 0), thick, thick, 0.7))
    return solids


def lamp(rng: Rng) -> list[Manifold]:
    """Straight, tripod, arc and two-arm stems, vases; cone, drum, ball, dome."""
    style = rng.choice(["straight", "tripod", "arc", "desk", "vase"])
    if style == "desk":
        return _desk_lamp(rng)
    tall = rng.uniform(0.9, 1.6)
    stem, base = rng.uniform(0.015, 0.03), rng.uniform(0.12, 0.22)
    disc = lathe([(base, 0), (base, 0.02), (base * rng.uniform(0.15, 0.9), 0.05)])
    head = np.array([0.0, 0.0, tall])
    if style == "straight":
        solids = [disc, rod((0, 0, 0.02), head, stem)]
    elif style == "tripod":
        knot, turn = np.array((0, 0, tall * rng.uniform(0.6, 0.95))), np.pi / 2
        solids = [rod(knot - (0, 0, 0.03), head, stem)]
        for angle in turn + 2 * np.pi * np.arange(3) / 3:
            tip = 1.6 * base * np.array((np.cos(angle), np.sin(angle), 0))
            solids.append(rod(tip, knot, stem * 0.8, stem, 12))
    elif style == "arc":
        reach, turn = rng.uniform(0.35, 0.75), np.linspace(np.pi, 0.12 * np.pi, 10)
        path = np.stack(
            [
                np.zeros(10),
                reach * (np.cos(turn) + 1) / 2,
                (tall - reach * 0.5) + reach * 0.5 * np.sin(turn),
            ],
            axis=1,
        )
        solids = [disc, rod((0, 0, 0.02), path[0], stem), *tube_along(path, stem)]
        head = path[-1]
    else:
        solids, head = _vase(rng, rng.uniform(0.3, 0.6))
    return solids + _shade(rng, head, stem, hanging=style == "arc")


def _vase(rng: Rng, tall: float) -> tuple[list[Manifold], np.ndarray]:
    radii = rng.uniform(0.05, 0.2, 5)
    radii[-1] = 0.04
    levels, fine = np.linspace(0, tall, 5), np.linspace(0, tall, 17)
    smooth = np.interp(fine, levels, radii)
    smooth = np.convolve(np.pad(smooth, 2, mode="edge"), np.ones(5) / 5, "valid")
    body = lathe(list(zip(smooth, fine, strict=True)), 28)
    head = np.array([0.0, 0.0, tall + rng.uniform(0.15, 0.25)])
    return [body, rod((0, 0, tall - 0.02), head, 0.015)], head


def _shade(rng: Rng, head: np.ndarray, stem: float, hanging: bool) -> list[Manifold]:
    """A shade about the end of the stem: a thin shell, or a closed ball."""
    kind = rng.choice(["cone", "drum", "ball", "dome"])
    radius, tall = rng.uniform(0.14, 0.27), rng.uniform(0.18, 0.34)
    if kind == "ball":
        return [ball(head, radius * 0.8, 28)]
    top = {"cone": rng.uniform(0.3, 0.75), "drum": 1.0, "dome": 0.25}[kind] * radius
    level = np.linspace(0, 1, 8 if kind == "dome" else 2)
    bow = np.sqrt(1 - level**2) if kind == "dome" else 1 - level
    outer, wall = top + (radius - top) * bow, 0.015
    shell = lathe(list(zip(outer, tall * level, strict=True)))
    inner = lathe(list(zip(outer - wall, tall * level * 0.96 - 0.01, strict=True)))
    low = head[2] - tall * (0.97 if hanging else rng.uniform(0.4, 0.8))
    cup = (shell - inner).translate((head[0], head[1], low))
    bulb = ball((head[0], head[1], low + tall * 0.5), 0.05, 14)
    neck = rod(
        (head[0], head[1], low + tall * 0.5), (*head[:2], low + tall - 0.004), stem
    )
    return [cup, bulb, neck]


def _desk_lamp(rng: Rng) -> list[Manifold]:
    """Two hinged arms over a heavy base, a conical head pointing down and ahead."""
    base, stem = rng.uniform(0.12, 0.18), rng.uniform(0.012, 0.02)
    lower, upper = rng.uniform(0.35, 0.5), rng.uniform(0.3, 0.5)
    first, second = rng.uniform(-0.7, 0.1), rng.uniform(0.5, 1.3)
    root = np.array([0.0, -base * 0.3, 0.03])
    elbow = root + lower * np.array([0, np.sin(first), np.cos(first)])
    head = elbow + upper * np.array([0, np.sin(second), np.cos(second)])
    tilt = rng.uniform(0.1, 0.9)
    aim, wide = np.array([0, np.sin(tilt), -np.cos(tilt)]), rng.uniform(0.09, 0.15)
    outer = rod(head - 0.06 * aim, head + 0.18 * aim, 0.035, wide, 28)
    inner = rod(head - 0.03 * aim, head + 0.19 * aim, 0.022, wide - 0.008, 28)
    if rng.random() < 0.5:
        foot = lathe([(base, 0), (base, 0.03), (base * 0.8, 0.045)])
    else:
        foot = box((0, 0, 0.02), (base * 2, base * 1.5, 0.04), 0.01)
    knuckles = [ball(point, stem * 1.9, 12) for point in (root, elbow)]
    return [
        foot,
        rod(root, elbow, stem),
        rod(elbow, head - 0.05 * aim, stem),
        outer - inner,
        ball(head, 0.045, 14),
        *knuckles,
    ]
