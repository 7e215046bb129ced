"""Procedural control cabinets."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import Solids, assembled, box, corners, rod, torus

Rng = np.random.Generator


def control_cabinet(rng: Rng) -> Solids:
    """Switch cabinets of one to four doors, a desk, or a small box on a wall plate or
    a post; vents, screens, buttons, lamps; an open door shows what is mounted."""
    kind = rng.choice(["tall", "tall", "desk", "box"])
    if kind == "desk":
        return assembled(_desk(rng))
    doors = int(rng.choice([1, 2, 3, 4], p=[0.32, 0.38, 0.2, 0.1]))
    rows = int(rng.choice([1, 2, 4, 6], p=[0.7, 0.1, 0.1, 0.1]))
    width = doors * rng.uniform(0.4, 0.6)
    height, depth = rng.uniform(1.3, 2.0), rng.uniform(0.35, 0.6)
    if kind == "box":
        doors, rows = min(doors, 2), 1
        width, height = rng.uniform(0.4, 0.8), rng.uniform(0.45, 0.9)
        depth = rng.uniform(0.18, 0.32)
    opened = int(rng.integers(doors)) if rows == 1 and rng.random() < 0.4 else -1
    body = box((0, 0, height / 2), (width, depth, height), 0.008)
    pitch, solids = width / doors, []
    for index in range(doors):
        x = (index + 0.5) * pitch - width / 2
        hinge = -1 if index % 2 == 0 else 1
        door = _column_of_doors(rng, pitch, height, hinge, rows)
        if index == opened:
            body -= box((x, 0.03, height / 2), (pitch * 0.92, depth, height * 0.92))
            plate = [box((0, 0, 0), (pitch, 0.02, height * 0.95))]
            plate += _mounting(rng, pitch * 0.8, height * 0.84)
            back = (x, -depth / 2 + 0.05, height / 2)
            solids += [part.translate(back) for part in plate]
            door = _opened(rng, door, hinge * pitch * 0.48, height)
        solids += [part.translate((x, depth / 2, height / 2)) for part in door]
    solids += [body, *_outside(rng, width, depth, height)]
    if kind == "tall":
        if rng.random() < 0.7:
            solids.append(box((0, 0, 0), (width * 0.97, depth * 0.94, 0.2)))
    elif rng.random() < 0.6:
        post, low = 0.09, rng.uniform(0.6, 1.0)
        solids.append(box((0, 0, -low / 2), (post, post, low + 0.05)))
        solids.append(box((0, 0, -low), (0.34, 0.34, 0.03)))
    else:
        wall = (width + 0.16, 0.03, height + 0.16)
        solids.append(box((0, -depth / 2, height / 2), wall))
    return assembled(solids)


def _column_of_doors(
    rng: Rng, width: float, height: float, hinge: int, rows: int
) -> Solids:
    """So many doors above one another about the origin, their outsides at +y."""
    tall = height * 0.97 / rows
    return [
        part.translate((0, 0, z))
        for z in (np.arange(rows) - (rows - 1) / 2) * tall
        for part in _door(rng, width * 0.96, tall * 0.985, hinge)
    ]


def _opened(rng: Rng, door: Solids, edge: float, height: float) -> Solids:
    """The door swung out about the upright axis at x = `edge`, and its hinges."""
    angle = -float(np.sign(edge)) * rng.uniform(60, 120)
    door = [part.translate((-edge, 0, 0)).rotate((0, 0, angle)) for part in door]
    door = [part.translate((edge, 0.02, 0)) for part in door]
    for z in (-0.36 * height, 0.36 * height):
        ends = [(edge, 0.02, z + s * 0.04) for s in (-1, 1)]
        door.append(rod(ends[0], ends[1], 0.026, segments=10))
    return door


def _door(rng: Rng, width: float, height: float, hinge: int) -> Solids:
    """A door about the origin in the plane y = 0, its outside at +y, with hinges at
    the given side, a handle at the other, and what is set into it."""
    solids = [box((0, 0.012, 0), (width, 0.03, height), 0.004)]
    for z in (-0.36, 0.36):
        ends = [(hinge * 0.49 * width, 0.025, z * height + s * 0.04) for s in (-1, 1)]
        solids.append(rod(ends[0], ends[1], 0.014, segments=8))
    x = -hinge * 0.4 * width
    if rng.random() < 0.5:
        solids.append(box((x, 0.035, 0), (0.035, 0.03, min(0.2, 0.6 * height))))
        solids.append(box((x, 0.055, 0.02), (0.022, 0.02, min(0.12, 0.4 * height))))
    else:
        for z in (-0.3, 0.3):
            lock = (x, 0.02, z * height)
            solids.append(rod(lock, np.add(lock, (0, 0.025, 0)), 0.02, segments=12))
    kinds = rng.choice(["vent", "fan", "screen", "buttons", "meters"], 2, replace=False)
    for kind, z in zip(kinds, (0.28, -0.3), strict=True):
        if rng.random() < 0.65 and (height > 0.6 or z > 0):
            z = z * height if height > 0.6 else 0.0
            center = np.array((0.03 * hinge * width, 0.027, z))
            solids += _fitting(str(kind), center, min(0.55 * width, 0.3, 0.9 * height))
    return solids


def _fitting(kind: str, center: np.ndarray, wide: float) -> Solids:
    """What is set into a door; the face there is at the centre's y."""
    if kind == "vent":
        return [
            box(center + (0, 0, z), (wide, 0.03, 0.014))
            for z in np.arange(-3, 4) * 0.03
        ]
    if kind == "fan":
        grille = [box(center, (wide, 0.03, wide), 0.008)]
        ring = torus(0.36 * wide, 0.012, segments=20).rotate((90, 0, 0))
        grille += [ring.translate(center + (0, 0.017, 0))]
        bars = (-0.2, 0.0, 0.2)
        return grille + [
            box(center + (0, 0.015, z * wide), (0.8 * wide, 0.02, 0.02)) for z in bars
        ]
    if kind == "screen":
        panel = box(center, (wide, 0.04, 0.7 * wide), 0.006)
        return [panel - box(center + (0, 0.02, 0), (0.84 * wide, 0.016, 0.54 * wide))]
    if kind == "meters":
        size = (0.3 * wide, 0.03, 0.3 * wide)
        return [box(center + (s * wide, 0, 0), size, 0.006) for s in (-0.4, 0, 0.4)]
    solids = []
    for column, row in np.ndindex(3, 2):
        foot = center + ((column - 1) * 0.3 * wide, -0.005, (row - 0.5) * 0.3 * wide)
        radius = 0.028 if (column, row) == (2, 1) else 0.018
        solids.append(rod(foot, foot + (0, 0.035, 0), radius, segments=12))
    return solids


def _mounting(rng: Rng, width: float, height: float) -> Solids:
    """Rows of devices and cable ducts in front of the plane y = 0."""
    rows = max(2, round(height / 0.28))
    pitch, solids = height / rows, []
    for row in range(rows):
        z = (row + 0.5) * pitch - height / 2
        solids.append(box((0, 0.03, z + pitch / 2), (width, 0.07, 0.04)))
        x = -width / 2
        while x < width / 2 - 0.08:
            wide = min(rng.uniform(0.05, 0.2), width / 2 - x)
            tall, deep = rng.uniform(0.4, 0.75) * pitch, rng.uniform(0.05, 0.13)
            center = (x + wide / 2, deep / 2, z)
            if rng.random() < 0.85:
                solids.append(box(center, (wide * 0.9, deep, tall)))
            x += wide
    return solids


def _outside(rng: Rng, width: float, depth: float, height: float) -> Solids:
    """On the roof eyes, a fan, a signal tower, or conduits; a fan at the side."""
    solids, kind = [], rng.choice(["eyes", "cooler", "tower", "conduits", "none"])
    if kind == "eyes":
        eye = torus(0.035, 0.011, segments=14).rotate((90, 0, 0))
        for point in corners(width / 2 - 0.05, depth / 2 - 0.05):
            solids.append(eye.translate(point + (0, 0, height + 0.03)))
    elif kind == "cooler":
        size = (min(0.4, 0.7 * width), depth * 0.7, rng.uniform(0.1, 0.25))
        solids.append(box((0, 0, height + size[2] / 2 - 0.005), size, 0.015))
    elif kind == "tower":
        foot = np.array((rng.uniform(-0.3, 0.3) * width, 0, height - 0.01))
        solids.append(rod(foot, foot + (0, 0, 0.12), 0.014, segments=8))
        for k in range(int(rng.integers(2, 5))):
            low = foot + (0, 0, 0.11 + 0.07 * k)
            solids.append(rod(low, low + (0, 0, 0.062), 0.036, segments=16))
            solids.append(rod(low, low + (0, 0, 0.072), 0.026, segments=12))
    elif kind == "conduits":
        count, tall = int(rng.integers(2, 6)), rng.uniform(0.15, 0.4)
        for x in np.linspace(-0.35, 0.35, count) * width:
            foot = np.array((x, -0.2 * depth, height - 0.01))
            solids.append(rod(foot, foot + (0, 0, tall), 0.025, segments=12))
            solids.append(rod(foot, foot + (0, 0, 0.04), 0.036, segments=6))
    if rng.random() < 0.4:
        side = rng.choice([-1, 1]) * (width / 2 + 0.04)
        unit = (0.12, depth * 0.65, height * rng.uniform(0.2, 0.45))
        solids.append(box((side, 0, height * 0.65), unit, 0.015))
    return solids


def _desk(rng: Rng) -> Solids:
    """A console with a sloping front full of buttons, a screen or more, and doors
    below."""
    width, y = rng.uniform(0.7, 1.6), rng.uniform(0.25, 0.35)
    knee, shelf = rng.uniform(0.7, 0.85), rng.uniform(0.2, 0.35)
    low, high, top = knee - 0.08, knee + 0.1, knee + rng.uniform(0.15, 0.5)
    edge, fold, roof = (y + 0.1, knee), (y - shelf, high), (-0.5 * y, top)
    solids = [
        _side_hull([(-y, 0.0), (0.7 * y, 0.0), (0.7 * y, low), (-y, low)], width),
        _side_hull([(-y, low), (0.7 * y, low), edge, fold, (-y, high)], width),
        _side_hull([(-y, knee + 0.05), fold, roof, (-y, top)], width),
    ]
    doors = max(1, round(width / 0.5))
    pitch = width / doors
    for x in (np.arange(doors) + 0.5) * pitch - width / 2:
        front, handle = (
            (x, 0.7 * y, low / 2),
            (x + 0.36 * pitch, 0.7 * y + 0.02, low / 2),
        )
        solids.append(box(front, (pitch * 0.9, 0.03, knee * 0.74), 0.004))
        solids.append(box(handle, (0.03, 0.04, 0.12)))
    for x in np.arange(-0.42, 0.43, 0.14 / width) * width:
        for share in (0.3, 0.55, 0.8):
            if rng.random() < 0.55:
                spot = np.array((x, *np.add(edge, share * np.subtract(fold, edge))))
                ends = spot - (0, 0, 0.02), spot + (0, 0, rng.choice([0.02, 0.045]))
                solids.append(rod(*ends, 0.02, segments=10))
    return solids + _desk_screens(rng, np.array(fold), np.array(roof), width)


def _desk_screens(rng: Rng, fold: np.ndarray, roof: np.ndarray, width: float) -> Solids:
    """One to three screens on the leaning face between two edges, (y, z) pairs."""
    along, middle = roof - fold, np.array((0, *(fold + roof) / 2))
    lean = float(np.degrees(np.arctan2(-along[0], along[1])))
    count = int(rng.integers(1, 4))
    size = np.array((0.7 * width / count, 0.03, 0.7 * np.linalg.norm(along)))
    screen = box((0, 0, 0), size, 0.004)
    screen -= box((0, 0.015, 0), size * (0.88, 0.8, 0.84))
    screen = screen.rotate((lean, 0, 0)).translate(middle + (0, 0.006, 0))
    places = (np.arange(count) - (count - 1) / 2) * width / count
    return [screen.translate((x, 0, 0)) for x in places]


def _side_hull(side: list[tuple[float, float]], width: float) -> Manifold:
    points = [(s * width / 2, y, z) for y, z in side for s in (-1, 1)]
    return Manifold.hull_points(np.array(points))
