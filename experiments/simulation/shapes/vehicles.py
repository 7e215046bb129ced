"""Procedural airplanes and cars, nose or bonnet to the front."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import (
    Rng,
    Solids,
    ball,
    bar,
    box,
    capsule,
    ellipse,
    loft,
    rod,
    side_profile,
    tube_along,
)


def airplane(rng: Rng) -> Solids:
    """Airliner, propeller plane, jet fighter or glider-like; nose along +y."""
    style = rng.choice(["airliner", "propeller", "fighter"], p=[0.45, 0.3, 0.25])
    radius = {"airliner": 0.1, "propeller": 0.11, "fighter": 0.085}[style]
    radius *= rng.uniform(0.8, 1.25)
    length = rng.uniform(1.5, 2.1) if style != "propeller" else rng.uniform(1.1, 1.5)
    solids = _fuselage(rng, style, radius, length)
    swept = {"airliner": (0.3, 0.7), "propeller": (-0.02, 0.12), "fighter": (0.5, 1.1)}
    span = rng.uniform(0.75, 1.15) if style != "fighter" else rng.uniform(0.5, 0.75)
    chord = rng.uniform(0.26, 0.4) if style != "fighter" else rng.uniform(0.5, 0.85)
    sweep = rng.uniform(*swept[style]) * span
    taper = rng.uniform(0.25, 0.55) if style != "propeller" else rng.uniform(0.6, 1.0)
    level = rng.choice([-0.6, 0.0, 0.7]) * radius
    dihedral = rng.uniform(-0.02, 0.12) * span
    front = chord / 2 + rng.uniform(-0.05, 0.15) - (0.2 if style == "fighter" else 0)
    wing = (np.array([0, front, level]), span, chord, taper, sweep, dihedral)
    solids += _wings(*wing, rng.uniform(0.025, 0.05))
    if style == "propeller" and rng.random() < 0.25:
        gap = radius * 2.2 - level
        solids += _wings(np.add(wing[0], (0, 0, gap)), *wing[1:], 0.03)
        for x in (-0.6 * span, 0.6 * span):
            y, z = front - 0.6 * sweep - chord * 0.3, level + 0.6 * dihedral
            solids.append(rod((x, y, z), (x, y, z + gap), 0.014, segments=10))
        solids.append(rod((0, front - 0.1, 0), (0, front - 0.1, level + gap), 0.03))
    solids += _tail(rng, style, radius, length)
    return solids + _engines(rng, style, radius, length, wing)


def _fuselage(rng: Rng, style: str, radius: float, length: float) -> Solids:
    nose, tail = rng.uniform(0.12, 0.25), rng.uniform(0.25, 0.45)
    sharp, flat = rng.uniform(0.5, 1.0), rng.uniform(0.85, 1.2)
    if style == "fighter":
        nose, tail, sharp = rng.uniform(0.35, 0.5), 0.3, 1.1
    back, front = -length / 2, length / 2
    end = 0.55 if style == "fighter" else 0.15
    sections = [
        ellipse((0, back, radius * (1 - end) * 0.6), (radius * end,) * 2),
        ellipse((0, back + tail * length, 0), (radius, radius * flat)),
    ]
    for step in np.linspace(0, 0.96, 6):
        shrink = (1 - step**2) ** (0.5 * sharp) if sharp <= 1 else 1 - step
        shrink, y = max(shrink, 0.08), front - nose * length * (1 - step)
        drop = -0.15 * radius * step
        sections.append(
            ellipse((0, y, drop), (radius * shrink, radius * flat * shrink))
        )
    solids = loft(sections)
    if style != "airliner":
        y = rng.uniform(0.1, 0.22) * length
        size = radius * np.array([0.6, rng.uniform(1.6, 2.6), 0.75])
        solids.append(ball((0, y, radius * flat * 0.75), size))
    return solids


def _wings(
    root: np.ndarray,
    span: float,
    chord: float,
    taper: float,
    sweep: float,
    dihedral: float,
    thick: float,
) -> Solids:
    """A mirrored pair of convex wings; `root` is the middle of the leading edge."""
    solids = []
    for side in (-1, 1):
        sections = []
        for share, scale in ((-0.02, 1.0), (1.0, taper)):
            lead = np.add(root, (side * span * share, -sweep * share, dihedral * share))
            depth, half = chord * scale, thick * scale / 2
            for y, height in [(0, 0.2), (-0.05, 1), (-0.35, 1), (-1, 0.2)]:
                sections.append(np.add(lead, (0, y * depth, height * half)))
                sections.append(np.add(lead, (0, y * depth, -height * half)))
        solids.append(Manifold.hull_points(np.array(sections)))
    return solids


def _tail(rng: Rng, style: str, radius: float, length: float) -> Solids:
    back, chord = -length / 2, rng.uniform(0.16, 0.26)
    tall, lean = rng.uniform(0.24, 0.4), rng.uniform(0.05, 0.25)
    base = np.array([0.0, back + chord * 1.05, radius * 0.45])
    fins = [-0.6, 0.6] if style == "fighter" and rng.random() < 0.5 else [0.0]
    is_t, solids = style != "fighter" and rng.random() < 0.3, []
    for fin in fins:
        foot = np.add(base, (fin * radius, 0, 0))
        tip, corners = np.add(foot, (fin * 0.12, -lean, tall)), []
        for point, depth in ((foot, chord), (tip, chord * 0.55)):
            for x in (-0.012, 0.012):
                corners += [np.add(point, (x, 0, 0)), np.add(point, (x, -depth, 0))]
        solids.append(Manifold.hull_points(np.array(corners)))
    level = tall * 0.97 if is_t else rng.uniform(-0.05, 0.1) * radius
    root = np.add(base, (0, -(lean * 0.97 if is_t else 0.0), level))
    span, sweep = rng.uniform(0.26, 0.4), rng.uniform(0.05, 0.2)
    size = chord * (0.6 if is_t else 0.9)
    return solids + _wings(root, span, size, 0.55, sweep, 0.0, 0.025)


def _engines(rng: Rng, style: str, radius: float, length: float, wing: tuple) -> Solids:
    root, span, chord, _, sweep, dihedral = wing
    if style == "fighter":
        nozzle, half = radius * 0.6, -length / 2
        return [
            rod(
                (x, half - 0.05, radius * 0.2), (x, half + 0.3, 0), nozzle * 0.8, nozzle
            )
            for x in ([0.0] if rng.random() < 0.5 else [-nozzle, nozzle])
        ]
    if style == "propeller":
        return _propeller(rng, radius, length)
    size, long = rng.uniform(0.045, 0.075), rng.uniform(0.2, 0.32)
    if rng.random() < 0.25:
        y, x = -length * 0.27, radius + size
        solids = [bar((-x, y, 0.04), (x, y, 0.04), 0.02, long * 0.5)]
        for side in (-x, x):
            solids += _nacelle(np.array((side, y + long / 2, 0.04)), size, long)
        return solids
    solids = []
    for share in [0.35] if rng.random() < 0.65 else [0.28, 0.58]:
        for side in (-share, share):
            point = np.add(
                root, (side * span, -abs(side) * sweep, abs(side) * dihedral)
            )
            nacelle = np.add(point, (0, long * 0.5, -size * 1.15))
            solids += _nacelle(nacelle, size, long)
            solids.append(
                bar(
                    nacelle - (0, long * 0.7, 0), point - (0, chord * 0.3, 0), 0.02, 0.1
                )
            )
    return solids


def _nacelle(front: np.ndarray, radius: float, length: float) -> Solids:
    body = rod(front - (0, length, 0), front, radius * 0.65, radius)
    return [body - rod(front - (0, 0.05, 0), np.add(front, (0, 0.01, 0)), radius * 0.8)]


def _propeller(rng: Rng, radius: float, length: float) -> Solids:
    nose = np.array((0.0, length / 2 - 0.01, -0.15 * radius))
    blade, count = rng.uniform(0.16, 0.26), int(rng.integers(2, 5))
    solids = [capsule(nose - (0, 0.05, 0), np.add(nose, (0, 0.03, 0)), 0.03, 0.012)]
    for angle in rng.uniform(0, np.pi) + 2 * np.pi * np.arange(count) / count:
        tip = nose + blade * np.array((np.cos(angle), 0, np.sin(angle)))
        solids.append(capsule(nose, tip, 0.016, 0.012, 8))
    if rng.random() < 0.6:
        for x in (-0.16, 0.16):
            foot = np.array((x, length * 0.15, -radius * 2.2))
            solids.append(rod((x * 0.3, length * 0.15, -radius * 0.5), foot, 0.015))
            solids.append(rod(foot - (0.018, 0, 0), np.add(foot, (0.018, 0, 0)), 0.055))
    return solids


def car(rng: Rng) -> Solids:
    """Saloon, hatchback, estate, van, pickup, bus and sports car; bonnet along +y."""
    style = str(
        rng.choice(["saloon", "hatchback", "estate", "van", "pickup", "bus", "sports"])
    )
    length = {"bus": 2.5, "van": 2.0, "hatchback": 1.65}.get(style, 1.9)
    length *= rng.uniform(0.92, 1.1)
    width, wheel = rng.uniform(0.68, 0.82), rng.uniform(0.13, 0.19)
    floor = wheel * rng.uniform(0.55, 1.1) if style != "sports" else wheel * 0.5
    belt = floor + {"bus": 0.4, "van": 0.36, "sports": 0.24}.get(style, 0.31)
    roof = belt + {"bus": 0.38, "van": 0.34, "sports": 0.17}.get(style, 0.25)
    roof += rng.uniform(-0.03, 0.05)
    half, bulge = length / 2, rng.uniform(0.01, 0.05)
    lower = [
        (-half, floor + 0.04),
        (-half + 0.06, floor),
        (half - 0.08, floor),
        (half, floor + 0.05),
        (half + bulge * 0.5, (floor + belt) / 2),
        (half - 0.03, belt - rng.uniform(0.02, 0.1)),
        (-half + 0.02, belt - rng.uniform(0.0, 0.04)),
    ]
    body = side_profile(np.array(lower), width)
    axles = rng.uniform(-0.68, -0.58) * half, rng.uniform(0.55, 0.66) * half
    arch = wheel * rng.uniform(1.1, 1.25)
    for y in axles:
        for side in (-1, 1):
            x = side * width / 2
            inner = (x - side * 0.16, y, wheel)
            body -= rod(inner, (x + side * 0.05, y, wheel), arch, segments=24)
    solids = [body, *_cabin(rng, style, half, width, belt, roof)]
    for y in axles:
        for side in (-1, 1):
            x, thick = side * width / 2, side * 0.11
            ends = (x - thick - side * 0.06, y, wheel), (x + side * 0.01, y, wheel)
            hub = (x + side * 0.025, y, wheel)
            solids += [rod(*ends, wheel, segments=24), rod(ends[0], hub, wheel * 0.5)]
    return solids + _car_details(rng, style, half, width, belt, floor)


def _cabin(
    rng: Rng, style: str, half: float, width: float, belt: float, roof: float
) -> Solids:
    """Greenhouse as a hull from the belt line to a narrower roof."""
    spans = {
        "saloon": ((-0.72, 0.38), (-0.42, 0.08)),
        "hatchback": ((-0.95, 0.42), (-0.78, 0.1)),
        "estate": ((-0.97, 0.4), (-0.88, 0.1)),
        "van": ((-0.99, 0.82), (-0.97, 0.5)),
        "pickup": ((-0.2, 0.42), (-0.16, 0.14)),
        "bus": ((-0.99, 0.985), (-0.98, 0.95)),
        "sports": ((-0.75, 0.3), (-0.32, -0.02)),
    }
    (low_back, low_front), (back, front) = spans[style]
    low_front, front = np.array((low_front, front)) + rng.uniform(-0.05, 0.05) * (
        style != "bus"
    )
    tuck, sink = rng.uniform(0.78, 0.92), 0.08
    base, edge = belt - sink, roof - 0.03
    corners = []
    for z, (rear, ahead), scale in (
        (base, (low_back, low_front), 0.97),
        (belt - 0.01, (low_back, low_front), 0.97),
        (edge, (back, front), tuck),
        (roof, (back + 0.05, front - 0.05), tuck * 0.9),
    ):
        for x in (-width / 2 * scale, width / 2 * scale):
            corners += [(x, rear * half, z), (x, ahead * half, z)]
    solids = [Manifold.hull_points(np.array(corners))]
    if style == "pickup":
        bed = np.array([(-0.94, 0), (-0.26, 0)]) * half
        size = (width * 0.86, bed[1, 0] - bed[0, 0], 0.3)
        center = (0, bed[:, 0].mean(), belt + 0.12)
        wall = box((0, center[1] - 0.01, belt), (width, size[1] + 0.08, 0.12))
        solids.append(wall - box(center, size))
    return solids


def _car_details(
    rng: Rng, style: str, half: float, width: float, belt: float, floor: float
) -> Solids:
    solids = []
    if rng.random() < 0.7:
        for side in (-1, 1):
            x = side * (width / 2 - 0.02)
            y = half * (0.15 if style == "sports" else 0.33)
            if style in ("van", "bus"):
                y = half * 0.78
            solids.append(box((x, y, belt + 0.02), (0.2, 0.05, 0.06), 0.01))
    for y in (-half, half):
        if rng.random() < 0.6:
            solids.append(box((0, y, floor + 0.08), (width * 0.94, 0.07, 0.07), 0.02))
    if style == "sports" and rng.random() < 0.6:
        y, level = -half * 0.92, belt + 0.08
        solids.append(box((0, y, level), (width * 0.9, 0.12, 0.02)))
        for x in (-width * 0.3, width * 0.3):
            solids.append(bar((x, y, belt - 0.06), (x, y, level), 0.02, 0.05))
    if style in ("estate", "van") and rng.random() < 0.4:
        solids += _roof_rack(half, width, belt + (0.25 if style == "estate" else 0.34))
    return solids


def _roof_rack(half: float, width: float, roof: float) -> Solids:
    solids = []
    for x in (-width * 0.3, width * 0.3):
        path = np.array([(x, -half * 0.7, roof + 0.09), (x, half * 0.05, roof + 0.09)])
        solids += tube_along(path, 0.014)
        solids += [rod(point - (0, 0, 0.15), point, 0.012) for point in path]
    return solids
