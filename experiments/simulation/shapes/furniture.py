"""Procedural chairs and tables."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import Rng, ball, bar, box, lathe, rod, tube_along


def chair(rng: Rng) -> list[Manifold]:
    """Four legs, pedestal, sled or panels; several backs; with or without arms."""
    width, depth = rng.uniform(0.42, 0.6), rng.uniform(0.4, 0.56)
    height, thick = rng.uniform(0.38, 0.52), rng.uniform(0.03, 0.1)
    round_seat = rng.random() < 0.2
    if round_seat:
        seat = lathe([(0.5, 0), (0.5, thick)]).scale((width, depth, 1))
        solids = [seat.translate((0, 0, height - thick))]
    else:
        chamfer = rng.uniform(0, 0.4) * thick
        solids = [box((0, 0, height - thick / 2), (width, depth, thick), chamfer)]
    under = height - thick / 2
    spread = 0.36 if round_seat else 0.46
    solids += _support(rng, width * 2 * spread, depth * 2 * spread, under)
    if rng.random() < 0.92:
        chord = (0.55, 0.8) if round_seat else (1.0, 1.0)
        solids += _chair_back(rng, width * chord[0], depth * chord[1], height)
    if not round_seat and rng.random() < 0.45:
        solids += _chair_arms(rng, width, depth, height)
    return solids


def table(rng: Rng) -> list[Manifold]:
    """Rectangular, round or chamfered top; apron, shelf or drawers in some."""
    width, depth = rng.uniform(0.8, 1.8), rng.uniform(0.6, 0.95)
    height, thick = rng.uniform(0.35, 0.85), rng.uniform(0.025, 0.08)
    style = rng.choice(["rectangle", "round", "chamfered"], p=[0.55, 0.25, 0.2])
    top = height - thick / 2
    if style == "round":
        if rng.random() < 0.6:
            width = depth
        disc = lathe([(0.5, 0), (0.5, thick)], 40).scale((width, depth, 1))
        solids, inset = [disc.translate((0, 0, height - thick))], 0.66
    elif style == "chamfered":
        solids, inset = [rounded_slab(width, depth, thick, 0.25 * depth, top)], 0.78
    else:
        solids, inset = [box((0, 0, top), (width, depth, thick))], 0.94
    inner = width * inset * rng.uniform(0.85, 1.0), depth * inset
    solids += _support(rng, *inner, top, shelf=0.25)
    if style != "round" and rng.random() < 0.35:
        size = (inner[0] * 0.97, inner[1] * 0.97, rng.uniform(0.06, 0.14))
        solids.append(box((0, 0, height - thick - size[2] / 2 + 0.01), size))
    if style == "rectangle" and rng.random() < 0.3:
        solids += _drawers(rng, inner[0], inner[1] * 0.9, top)
    return solids


def _support(
    rng: Rng, width: float, depth: float, top: float, shelf: float = 0.0
) -> list[Manifold]:
    """Legs under a seat or a table top of the given footprint; between four legs
    a shelf with probability `shelf`."""
    style = rng.choice(
        ["legs", "pedestal", "sled", "panels"], p=[0.55, 0.2, 0.13, 0.12]
    )
    if style == "pedestal":
        return _pedestal(rng, min(width, depth) * 0.55, top)
    x, y = width / 2, depth / 2
    thick = rng.uniform(0.022, 0.05)
    if style == "panels":
        return [box((s * x, 0, top / 2), (thick, depth, top)) for s in (-1, 1)]
    if style == "sled":
        solids = []
        for side in (-x, x):
            corners = [(side, -y, top), (side, -y, thick), (side, y, thick)]
            solids += tube_along(np.array([*corners, (side, y, top)]), thick * 0.7)
        return solids
    return _four_legs(rng, x, y, top, thick, shelf)


def _four_legs(
    rng: Rng, x: float, y: float, top: float, thick: float, shelf: float
) -> list[Manifold]:
    splay = 1 + (rng.uniform(0.02, 0.25) if rng.random() < 0.45 else 0.0)
    taper, is_round = rng.uniform(0.45, 1.0), rng.random() < 0.5
    feet, solids = [], []
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        head = np.array((sx * (x - thick / 2), sy * (y - thick / 2), top))
        foot = head * (splay, splay, 0)
        feet.append((head, foot))
        if is_round:
            solids.append(rod(head, foot, thick / 1.8, taper * thick / 1.8))
        else:
            solids.append(bar(head, foot, thick, thick, taper))
    level = rng.uniform(0.15, 0.5)
    joints = [head * level + foot * (1 - level) for head, foot in feet]
    if rng.random() < shelf:
        solids.append(box((0, 0, top * level), (*(2 * joints[2][:2]), 0.03)))
    elif rng.random() < 0.4:
        pairs = [(0, 3), (1, 2)]
        pairs += [(0, 1), (2, 3)] if rng.random() < 0.6 else []
        solids += [rod(joints[i], joints[j], thick / 3.5) for i, j in pairs]
    return solids


def _pedestal(rng: Rng, reach: float, top: float) -> list[Manifold]:
    """Column on a disc or on a star of three to five feet, with or without castors."""
    radius = rng.uniform(0.025, 0.06)
    if rng.random() < 0.45:
        rim = rng.uniform(0.02, 0.05)
        disc = lathe([(reach, 0), (reach, rim * 0.5), (radius, rim + 0.03)])
        return [disc, rod((0, 0, 0.01), (0, 0, top), radius)]
    count, castor = int(rng.integers(3, 6)), rng.uniform(0.025, 0.045)
    has_castors, start = rng.random() < 0.6, rng.choice([0.0, np.pi / 2])
    hub = 2.2 * castor + 0.04
    solids = [rod((0, 0, hub - 0.05), (0, 0, top), radius)]
    for angle in start + 2 * np.pi * np.arange(count) / count:
        tip = reach * np.array([np.cos(angle), np.sin(angle), 0])
        tip[2] = 2 * castor if has_castors else 0.02
        solids.append(rod((0, 0, hub), tip, 0.03, 0.018, 10))
        if has_castors:
            solids.append(ball(tip - (0, 0, castor), castor, 14))
    return solids


def _chair_back(rng: Rng, width: float, depth: float, height: float) -> list[Manifold]:
    """Panel, framed panel, slats or rungs, leaning backwards."""
    tall, lean = rng.uniform(0.3, 0.62), rng.uniform(0.0, 0.14)
    thick, wide = rng.uniform(0.025, 0.06), width * rng.uniform(0.8, 1.0)
    style, y = rng.choice(["panel", "slats", "rungs", "pad"]), -depth / 2 + thick / 2

    def at(x, level) -> np.ndarray:
        """Point of the leaning back plane; level 0 is the seat and 1 the top."""
        return np.array([x, y - lean * level, height - 0.02 + tall * level])

    if style == "panel":
        return [bar(at(0, 0), at(0, 1), wide, thick, rng.uniform(0.75, 1.0))]
    edge = wide / 2 - thick / 2
    solids = [bar(at(s * edge, 0), at(s * edge, 1), thick, thick) for s in (-1, 1)]
    top_rail = rng.uniform(0.05, 0.12)
    solids.append(bar(at(0, 1 - top_rail / tall), at(0, 1), wide, thick * 1.1))
    if style == "pad":
        low, high = rng.uniform(0.1, 0.35), rng.uniform(0.75, 0.95)
        solids.append(bar(at(0, low), at(0, high), wide, thick * 0.7))
    elif style == "slats":
        for x in np.linspace(-edge, edge, int(rng.integers(3, 8)) + 2)[1:-1]:
            solids.append(bar(at(x, 0), at(x, 0.98), thick * 0.6, thick * 0.5))
    else:
        for level in np.linspace(0.2, 0.8, int(rng.integers(1, 5))):
            half = 0.03 / tall
            ends = at(0, level - half), at(0, level + half)
            solids.append(bar(*ends, wide - thick / 2, thick * 0.6))
    return solids


def _chair_arms(rng: Rng, width: float, depth: float, height: float) -> list[Manifold]:
    rise, thick = rng.uniform(0.16, 0.26), rng.uniform(0.03, 0.06)
    x, front = width / 2 - thick / 4, depth * rng.uniform(0.2, 0.45)
    back, solids = -depth / 2 + 0.01, []
    closed = rng.random() < 0.25
    for side in (-x, x):
        if closed:
            low = height - 0.04
            center = (side, (front + back) / 2, (low + height + rise) / 2)
            solids.append(box(center, (thick, front - back, height + rise - low)))
            continue
        center = (side, (front + back) / 2, height + rise)
        solids.append(box(center, (thick * 1.3, front - back, thick * 0.6)))
        for y in (front - thick, back + thick / 2):
            foot = (side, y, height - 0.03)
            solids.append(bar(foot, (side, y, height + rise), thick * 0.6, thick * 0.6))
    return solids


def rounded_slab(
    width: float, depth: float, thick: float, radius: float, z: float
) -> Manifold:
    """Horizontal slab centred at height z whose four upright edges are rounded."""
    x, y = width / 2 - radius, depth / 2 - radius
    low, high = z - thick / 2, z + thick / 2
    posts = [
        rod((sx * x, sy * y, low), (sx * x, sy * y, high), radius, segments=24)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return Manifold.batch_hull(posts)


def _drawers(rng: Rng, width: float, depth: float, top: float) -> list[Manifold]:
    wide, count = width * rng.uniform(0.22, 0.32), int(rng.integers(1, 4))
    tall = top * rng.uniform(0.35, 0.95)
    sides, solids = [(-1,), (1,), (-1, 1)][rng.integers(3)], []
    for side in sides:
        x = side * (width - wide) / 2
        solids.append(box((x, 0, top - tall / 2), (wide, depth, tall)))
        for index in range(count):
            z = top - tall * (index + 0.5) / count
            front = (wide * 0.88, 0.03, tall / count * 0.82)
            solids.append(box((x, depth / 2, z), front))
    return solids
