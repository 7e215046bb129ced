"""Procedural pallets."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import Rng, assembled, bar, box, corners, rod, union


def pallet(rng: Rng) -> list[Manifold]:
    """Boards on blocks or stringers, or moulded; empty, or with cartons, drums, sacks,
    a collar or a mesh cage."""
    width, depth = rng.choice([0.8, 1.0, 1.2]), rng.choice([0.8, 1.0, 1.2])
    style = str(rng.choice(["blocks", "stringers", "moulded"], p=[0.42, 0.33, 0.25]))
    height = rng.uniform(0.12, 0.17)
    if style == "moulded":
        solids = _moulded(rng, width, depth, height)
    else:
        solids = _boards(rng, style, width, depth, height)
    kinds = ["none", "cartons", "drums", "sacks", "collar", "cage", "stack"]
    load = str(rng.choice(kinds, p=[0.36, 0.2, 0.1, 0.08, 0.1, 0.08, 0.08]))
    if load == "stack":
        count = int(rng.integers(2, 6))
        shifts = [(0, 0, k * (height - 0.002)) for k in range(count)]
        return assembled([part.translate(s) for s in shifts for part in solids])
    return assembled(solids + _load(rng, load, width, depth, height - 0.002))


def _boards(
    rng: Rng, style: str, width: float, depth: float, height: float
) -> list[Manifold]:
    """Deck boards along x over bearers along y; bottom boards in some."""
    thick, count = 0.022, int(rng.integers(4, 10))
    share, solids = rng.uniform(0.6, 0.92), []
    pitch = depth / count
    for k in range(count):
        wide = pitch * (1.0 if k in (0, count - 1) else share)
        y = (k + 0.5) * pitch - depth / 2
        deck = (width, wide, thick + 0.004)
        solids.append(box((0, y, height - thick / 2 - 0.002), deck))
    rows = np.linspace(-1, 1, int(rng.choice([3, 3, 4])))
    low = 0.0 if rng.random() < 0.3 else thick
    bearer = rng.uniform(0.08, 0.13) if style == "blocks" else 0.045
    for x in rows * (width - bearer) / 2:
        if style == "stringers":
            tall = height - thick
            beam = box((x, 0, tall / 2), (bearer, depth, tall))
            if low == 0:
                for y in (-0.25 * depth, 0.25 * depth):
                    beam -= box((x, y, 0.0), (1, 0.22 * depth, 0.1))
            solids.append(beam)
            continue
        board = (bearer, depth, thick + 0.004)
        solids.append(box((x, 0, height - 1.5 * thick - 0.002), board))
        for y in np.array((-1, 0, 1)) * (depth - 0.13) / 2:
            tall = height - thick
            solids.append(box((x, y, tall / 2), (bearer, 0.13, tall)))
        if low:
            solids.append(box((x, 0, thick / 2), (0.98 * bearer, depth, thick)))
    if low and style == "stringers":
        for y in np.linspace(-1, 1, int(rng.integers(2, 6))) * (depth - 0.1) / 2:
            solids.append(box((0, y, thick / 2), (width, 0.1, thick)))
    return solids


def _moulded(rng: Rng, width: float, depth: float, height: float) -> list[Manifold]:
    """Plastic deck with slots and a rim, on nine feet or three runners."""
    thick, cells = 0.04, rng.integers(3, 8, 2)
    deck, slots = box((0, 0, height - thick / 2), (width, depth, thick), 0.008), []
    if rng.random() < 0.75:
        for i, j in np.ndindex(*cells):
            x, y = ((k + 0.5) / n - 0.5 for k, n in ((i, cells[0]), (j, cells[1])))
            size = (0.55 * width / cells[0], 0.7 * depth / cells[1], 1.0)
            slots.append(box((0.96 * x * width, 0.96 * y * depth, height), size))
        deck -= union(slots)
    solids = [deck]
    if rng.random() < 0.4:
        rim = box((0, 0, height + 0.005), (width, depth, 0.03), 0.005)
        solids.append(rim - box((0, 0, height), (width - 0.04, depth - 0.04, 1)))
    is_nested, runner = rng.random() < 0.4, rng.random() < 0.5
    for x in np.array((-1, 0, 1)) * (width / 2 - 0.09):
        for y in np.array((-1, 0, 1)) * (depth / 2 - 0.09):
            top = (x, y, height)
            if is_nested:
                solids.append(rod((x, y, 0), top, 0.05, 0.085, 16))
            else:
                solids.append(bar(top, (x, y, 0), 0.16, 0.16, 0.85))
        if runner:
            solids.append(box((x, 0, 0.012), (0.13, depth - 0.04, 0.024)))
    return solids


def _load(
    rng: Rng, load: str, width: float, depth: float, top: float
) -> list[Manifold]:
    if load == "cartons":
        return _cartons(rng, width, depth, top)
    if load == "drums":
        radius, tall = 0.235 * min(width, depth), rng.uniform(0.6, 0.9)
        solids = []
        for foot in corners(width / 4, depth / 4)[: int(rng.integers(2, 5))]:
            low = foot + (0, 0, top)
            solids.append(rod(low, low + (0, 0, tall), radius, segments=24))
            for level in (0.0, 0.33, 0.66, 0.97):
                hoop = low + (0, 0, level * tall)
                ring = rod(hoop, hoop + (0, 0, 0.025), 1.05 * radius, segments=24)
                solids.append(ring)
        return solids
    if load == "sacks":
        solids, tall = [], 0.13
        for layer in range(int(rng.integers(2, 6))):
            turned = layer % 2
            size = (width / 2, depth / 3) if turned else (width / 3, depth / 2)
            for i, j in np.ndindex(2 + (1 - turned), 2 + turned):
                x, y = (i + 0.5) * size[0], (j + 0.5) * size[1]
                center = (x - width / 2, y - depth / 2, top + (layer + 0.45) * tall)
                sack = (size[0] * 1.01, size[1] * 1.01, tall * 1.1)
                solids.append(box(center, sack, 0.045))
        return solids
    if load == "collar":
        tall = rng.choice([0.2, 0.4, 0.6])
        shell = box((0, 0, top + tall / 2), (width, depth, tall))
        shell -= box((0, 0, top + 0.02 + tall / 2), (width - 0.05, depth - 0.05, tall))
        level = rng.uniform(0.0, 0.7) * tall
        goods = box((0, 0, top + level / 2), (width - 0.03, depth - 0.03, level + 0.05))
        return [shell, goods]
    return _cage(rng, width, depth, top) if load == "cage" else []


def _cartons(rng: Rng, width: float, depth: float, top: float) -> list[Manifold]:
    """Layers of boxes with the odd gap; the last layer is often unfinished."""
    columns, rows = rng.integers(1, 5, 2)
    layers, tall = int(rng.integers(1, 5)), rng.uniform(0.18, 0.35)
    share = (
        width * rng.uniform(0.88, 1.0) / columns,
        depth * rng.uniform(0.88, 1.0) / rows,
    )
    solids = []
    for layer in range(layers):
        keep = 1.0 if layer < layers - 1 else rng.uniform(0.3, 1.0)
        for i, j in np.ndindex(columns, rows):
            if rng.random() < keep:
                x, y = (
                    (i + 0.5 - columns / 2) * share[0],
                    (j + 0.5 - rows / 2) * share[1],
                )
                shift = rng.uniform(-0.008, 0.008, 2)
                center = (x + shift[0], y + shift[1], top + (layer + 0.49) * tall)
                size = (share[0] * 0.975, share[1] * 0.975, tall * 1.01)
                solids.append(box(center, size))
    return solids


def _cage(rng: Rng, width: float, depth: float, top: float) -> list[Manifold]:
    """Walls of upright and level wires between four posts."""
    tall, solids = rng.uniform(0.5, 0.9), []
    x, y = width / 2 - 0.02, depth / 2 - 0.02
    for foot in corners(x, y):
        solids.append(box(foot + (0, 0, top + tall / 2), (0.04, 0.04, tall + 0.02)))
    for level in np.linspace(0.05, 1, int(rng.integers(4, 7))) * tall:
        z = top + level - 0.01
        for side in (-1, 1):
            solids.append(box((0, side * y, z), (2 * x, 0.016, 0.016)))
            solids.append(box((side * x, 0, z), (0.016, 2 * y, 0.016)))
    for share in np.linspace(-1, 1, int(rng.integers(6, 10)))[1:-1]:
        for side in (-1, 1):
            center = top + tall / 2
            solids.append(box((share * x, side * y, center), (0.014, 0.014, tall)))
            solids.append(box((side * x, share * y, center), (0.014, 0.014, tall)))
    return solids
