"""Procedural bottles, mugs and bowls."""

import numpy as np

from experiments.simulation.solids import (
    Rng,
    Solids,
    assembled,
    ball,
    box,
    lathe,
    ring_of,
    rod,
    torus,
    tube_along,
    union,
)


def bottle(rng: Rng) -> Solids:
    """Round, oval or square body; shoulder, neck, cap; jug handles and pumps."""
    radius, body = rng.uniform(0.12, 0.24), rng.uniform(0.3, 0.75)
    neck, shoulder = radius * rng.uniform(0.25, 0.6), rng.uniform(0.04, 0.25)
    neck_tall = rng.uniform(0.03, 0.25)
    style = rng.choice(["round", "waisted", "tapered", "square", "oval"])
    level = np.linspace(0, 1, 10)
    waist = {
        "waisted": 1 - rng.uniform(0.1, 0.3) * np.sin(np.pi * level) ** 2,
        "tapered": 1 - rng.uniform(-0.25, 0.3) * level,
    }.get(style, np.ones(10))
    foot = radius * rng.uniform(0.03, 0.15)
    side = [(radius * w, foot + body * t) for w, t in zip(waist, level, strict=True)]
    ease = np.sin(np.linspace(0, np.pi / 2, 8)[1:]) ** rng.uniform(0.8, 2.2)
    top, high = side[-1][0], foot + body
    slope = [
        (top + (neck - top) * e, high + shoulder * t)
        for e, t in zip(ease, np.linspace(0, 1, 8)[1:], strict=True)
    ]
    end = high + shoulder + neck_tall
    profile = [(side[0][0] - foot, 0), *side, *slope, (neck * 0.95, end)]
    if style == "square":
        solid = lathe(profile, 4).rotate((0, 0, 45))
    else:
        flat = rng.uniform(0.5, 0.8) if style == "oval" else 1.0
        solid = lathe(profile, 40).scale((1, flat, 1))
        neck *= flat
    solids = [solid]
    kind = rng.choice(["cap", "lip", "cork", "pump"], p=[0.45, 0.25, 0.15, 0.15])
    tall = rng.uniform(0.03, 0.09)
    if kind == "cap":
        wide, low = neck * rng.uniform(1.05, 1.35), end - tall * 0.7
        solids.append(rod((0, 0, low), (0, 0, low + tall), wide, wide * 0.97, 28))
    elif kind == "lip":
        solids.append(rod((0, 0, end - 0.03), (0, 0, end), neck * 1.2, segments=28))
    elif kind == "cork":
        solids.append(
            rod((0, 0, end - 0.02), (0, 0, end + tall), neck * 0.7, neck * 0.85)
        )
    else:
        solids += _pump(rng, neck, end)
    if rng.random() < 0.15:
        solids += _jug_handle(rng, radius, body)
    return solids


def _pump(rng: Rng, neck: float, end: float) -> Solids:
    rise, reach = rng.uniform(0.06, 0.12), rng.uniform(0.08, 0.16)
    head = end + rise
    return [
        rod((0, 0, end - 0.03), (0, 0, end + 0.03), neck * 1.15),
        rod((0, 0, end), (0, 0, head), neck * 0.3),
        box((0, reach / 2 - 0.02, head), (neck, reach + 0.04, 0.035), 0.008),
        rod((0, reach - 0.01, head), (0, reach - 0.01, head - 0.05), 0.012),
    ]


def _jug_handle(rng: Rng, radius: float, body: float) -> Solids:
    low, high = body * rng.uniform(0.25, 0.45), body * rng.uniform(0.8, 1.0)
    out, inside = radius + rng.uniform(0.08, 0.12), radius * 0.75
    path = [(inside, high), (out, high), (out, low), (inside, low)]
    return tube_along(np.array([(x, 0.0, z) for x, z in path]), 0.022)


def mug(rng: Rng) -> Solids:
    """Hollow cup, straight, tapered or bellied, with several handles along +x."""
    tall, radius = rng.uniform(0.6, 1.15), rng.uniform(0.32, 0.48)
    wall, floor = rng.uniform(0.03, 0.06), rng.uniform(0.04, 0.1)
    taper, belly = rng.uniform(-0.08, 0.3), rng.choice([0.0, rng.uniform(0.05, 0.2)])
    level = np.linspace(0, 1, 9)
    outer = radius * (1 - taper * (1 - level) + belly * np.sin(np.pi * level))
    foot = rng.uniform(0.0, 0.04)
    outside = [(outer[0] - foot, 0.0)]
    outside += list(zip(outer, foot + (tall - foot) * level, strict=True))
    inside = list(zip(outer - wall, floor + (tall - floor) * level, strict=True))
    inside.append((outer[-1] - wall, tall + 0.1))
    cavity, solids = lathe(inside, 48), [lathe(outside, 48)]
    if rng.random() < 0.92:
        solids += _mug_handle(rng, tall, lambda z: np.interp(z / tall, level, outer))
    cup = union(solids) - cavity
    if rng.random() < 0.12:
        rim = rng.uniform(1.5, 1.9) * outer[0]
        saucer = lathe([(rim * 0.55, -0.06), (rim, 0.03), (rim, 0.06)], 48)
        saucer -= lathe([(rim * 0.5, -0.01), (rim * 0.95, 0.07)], 48)
        return [cup.translate((0, 0, -0.02)), saucer]
    return [cup]


def _mug_handle(rng: Rng, tall: float, radius_at) -> Solids:
    """Ring, ear or square handle, its ends sunk into the wall."""
    low, high = tall * rng.uniform(0.12, 0.3), tall * rng.uniform(0.7, 0.9)
    reach, thick = rng.uniform(0.2, 0.36), rng.uniform(0.035, 0.06)
    bottom, top = float(radius_at(low)), float(radius_at(high))
    style = rng.choice(["ring", "ear", "square"])
    if style == "square":
        out = max(bottom, top) + reach
        path = [(top, high), (out, high), (out, low), (bottom, low)]
    else:
        turn = np.linspace(np.pi / 2, -np.pi / 2, 13)
        sag = 0.25 * np.sin(2 * turn) * (style == "ear")
        level = (np.sin(turn) + 1) / 2
        path = np.stack(
            [
                bottom + (top - bottom) * level + reach * (np.cos(turn) + sag * 0.6),
                low + (high - low) * level,
            ],
            axis=1,
        )
    solids = tube_along(np.array([(x, 0.0, z) for x, z in path]), thick)
    return [union(solids).scale((1, rng.uniform(0.9, 1.7), 1))]


def bowl(rng: Rng) -> Solids:
    """Round, oval, square, many-sided or fluted; deep to flat; on a foot ring, on a
    stem, on three feet; with a rim or two ears."""
    radius, tall = rng.uniform(0.3, 0.5), rng.uniform(0.14, 0.42)
    wall, floor = rng.uniform(0.015, 0.04), rng.uniform(0.03, 0.07)
    kind = str(rng.choice(["round", "oval", "square", "sides", "fluted"]))
    curve = str(rng.choice(["dome", "cone", "flared", "straight"]))
    if curve == "straight" and kind != "round":
        curve = "dome"
    foot, level = radius * rng.uniform(0.3, 0.6), np.linspace(0, 1, 10)
    rise = {
        "dome": np.sqrt(1 - (1 - level) ** 2),
        "cone": level,
        "flared": 0.55 * np.sqrt(1 - (1 - level) ** 2) + 0.45 * level**3,
        "straight": np.minimum(1.0, 0.75 + 2.5 * level),
    }[curve]
    outer = foot + (radius - foot) * rise
    outside = [*zip(outer, tall * level, strict=True)]
    if rng.random() < 0.3:
        outside[-1:] = [(radius, tall * 0.96), (radius + 0.05, tall * 0.965)]
        outside.append((radius + 0.05, tall))
    hollow = np.interp(floor / tall + level * (1 - floor / tall), level, outer) - wall
    inside = [*zip(hollow, floor + (tall - floor) * level, strict=True)]
    inside.append((hollow[-1], tall + 0.1))
    count = {"square": 4, "sides": int(rng.integers(5, 9)), "fluted": 72}.get(kind, 40)
    cup = lathe(outside, count) - lathe(inside, count)
    parts = [cup, *_bowl_foot(rng, foot, count)]
    if kind == "square":
        parts = [part.rotate((0, 0, 45)) for part in parts]
    if kind != "fluted" and rng.random() < 0.2:
        flat, high = np.cos(np.pi / count), tall * rng.uniform(0.78, 0.9)
        parts += _ears(rng, flat * np.interp(high / tall, level, outer), high, wall)
    if kind == "oval":
        flat = rng.uniform(0.55, 0.8)
        parts = [part.scale((1, flat, 1)) for part in parts]
    if kind == "fluted":
        lobes, depth = int(rng.integers(5, 13)), rng.uniform(0.04, 0.1)
        parts[0] = cup.warp_batch(_flutes(lobes, depth, tall))
    return assembled(parts)


def _flutes(lobes: int, depth: float, tall: float):
    """A warp that moves the wall in and out around the axis, most at the rim."""

    def warp(points: np.ndarray) -> np.ndarray:
        turn = np.arctan2(points[:, 1], points[:, 0])
        swing = 1 + depth * np.cos(lobes * turn) * (points[:, 2] / tall) ** 1.5
        return points * np.stack([swing, swing, np.ones_like(swing)], axis=1)

    return warp


def _bowl_foot(rng: Rng, foot: float, count: int) -> Solids:
    style = rng.choice(["none", "ring", "stem", "feet"], p=[0.3, 0.4, 0.18, 0.12])
    if style == "ring":
        deep = rng.uniform(0.02, 0.05)
        ring = lathe([(foot * 0.85, -deep), (foot * 0.95, 0.03)], count)
        return [ring - lathe([(foot * 0.7, -deep - 0.01), (foot * 0.7, -0.002)], count)]
    if style == "stem":
        deep, slim = rng.uniform(0.08, 0.25), foot * rng.uniform(0.3, 0.6)
        profile = [(foot * 1.1, 0), (foot * 1.1, 0.02), (slim, 0.05)]
        profile += [(slim, deep), (foot * 0.9, deep + 0.02)]
        return [lathe(profile, count).translate((0, 0, -deep))]
    if style == "feet":
        return ring_of(ball((foot * 0.8, 0, -0.02), 0.045, 12), 3, 90.0)
    return []


def _ears(rng: Rng, radius: float, level: float, wall: float) -> Solids:
    """Two loops or two round tabs along +-x, on the wall's radius at this level."""
    wide, thick = rng.uniform(0.08, 0.14), rng.uniform(0.014, 0.022)
    if rng.random() < 0.5:
        tab = rod((0, 0, -thick), (0, 0, thick), wide, segments=24)
        ear = tab.trim_by_plane((1, 0, 0), -0.5 * wall)
    else:
        ear = torus(wide, thick, 200.0, 20).rotate((0, 0, -100))
    near = radius - 0.3 * wall
    return [
        ear.translate((near, 0, level)),
        ear.mirror((1, 0, 0)).translate((-near, 0, level)),
    ]
