"""Procedural gearboxes, and the electric motor that other machines borrow."""

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from experiments.simulation.solids import (
    Rng,
    Solids,
    assembled,
    box,
    corners,
    one_of,
    ring_of,
    rod,
    torus,
)


def disc(radius: float, low: float, high: float, segments: int = 28) -> Manifold:
    """Cylinder about z between two heights."""
    return rod((0, 0, low), (0, 0, high), radius, segments=segments)


def bolts(count: int, circle: float, radius: float, low: float, high: float) -> Solids:
    """Hexagonal heads on a circle about z."""
    head = rod((circle, 0, low), (circle, 0, high), radius, segments=6)
    return ring_of(head, count, 180 / count)


def motor(rng: Rng, radius: float, length: float) -> Solids:
    """Electric motor along +z from its flange at z = 0: ribbed, smooth or square (a
    servo), with fan cover and terminal box at +x."""
    kind = str(rng.choice(["ribbed", "ribbed", "smooth", "servo"]))
    end = length * 0.78
    if kind == "servo":
        side = 1.8 * radius
        solids = [box((0, 0, length * 0.4), (side, side, length * 0.8), 0.15 * radius)]
        solids.append(
            box((0, 0, length * 0.87), (side * 0.9, side * 0.9, length * 0.25))
        )
        plug = (0.9 * radius, 0, length * 0.8)
        return [*solids, rod(plug, np.add(plug, (0.5 * radius, 0, 0)), 0.25 * radius)]
    solids = [disc(1.15 * radius, -0.002, 0.06 * length), disc(0.9 * radius, 0.0, end)]
    if kind == "ribbed":
        fin = CrossSection.square((0.3 * radius, 0.07 * radius), True)
        fins = [
            fin.translate((0.88 * radius, 0.0)).rotate(10 + 20 * k) for k in range(18)
        ]
        core = CrossSection.circle(0.85 * radius, 36)
        ribs = CrossSection.batch_boolean([core, *fins], OpType.Add).extrude(end * 0.8)
        solids.append(ribs.translate((0, 0, 0.1 * length)))
    solids.append(rod((0, 0, end - 0.01), (0, 0, length), radius, 0.85 * radius, 28))
    center = (radius, 0, 0.45 * length)
    return [*solids, box(center, (0.6 * radius, 0.8 * radius, 0.3 * length), 0.01)]


def gearbox(rng: Rng) -> Solids:
    """In-line, parallel-shaft, right-angle, worm and planetary; feet or flange;
    with and without a motor."""
    makers = _inline, _split_housing, _right_angle, _worm, _planetary
    return assembled(one_of(rng, makers, (0.2, 0.27, 0.18, 0.2, 0.15)))


def _shaft(rng: Rng, radius: float, start: float, end: float) -> Solids:
    """Shaft along z to `end`, with a shoulder and a keyway in some, or a hollow one."""
    if rng.random() < 0.2:
        hub = disc(1.7 * radius, start, start + 0.35 * (end - start))
        return [hub - disc(radius, start + 0.01, end)]
    solids = [disc(radius, start, end, 20)]
    if rng.random() < 0.7:
        solids[0] -= box(
            (radius, 0, end), (0.6 * radius, 0.5 * radius, 0.9 * (end - start))
        )
    return [*solids, disc(1.5 * radius, start, start + 0.25 * (end - start))]


def _along_y(solids: Solids, point: tuple) -> Solids:
    """Turns the z axis to +y and moves the origin to a point."""
    return [solid.rotate((-90, 0, 0)).translate(point) for solid in solids]


def _inline(rng: Rng) -> Solids:
    """Round stepped housing on feet, shaft to the front, motor behind."""
    radius, long = rng.uniform(0.13, 0.19), rng.uniform(0.28, 0.45)
    front = rng.uniform(0.6, 0.85) * radius
    parts = [
        disc(radius, 0.3 * long, long),
        disc(0.9 * radius, 0.1 * long, long + 0.02),
    ]
    nose = rod((0, 0, long * 1.3), (0, 0, long * 0.9), front * 0.9, radius * 0.95, 28)
    parts += [nose, disc(front, long * 1.2, long * 1.35)]
    parts += _shaft(rng, radius * 0.3, long * 1.3, long * 1.3 + radius * 1.1)
    parts += bolts(8, 0.9 * radius, 0.09 * radius, long, long + 0.03)
    if rng.random() < 0.75:
        drive = motor(rng, radius * rng.uniform(0.7, 0.95), rng.uniform(0.3, 0.45))
        parts += [p.rotate((180, 0, 0)).translate((0, 0, 0.12 * long)) for p in drive]
    else:
        parts += [disc(0.25 * radius, -0.5 * radius, 0.3 * long)]
    solids = _along_y(parts, (0, -0.5 * long, 0))
    if rng.random() < 0.75:
        low, wide = -1.15 * radius, 1.1 * radius
        foot = box((0, 0.15 * long, low), (2.6 * radius, 0.8 * long, 0.05))
        holes = [
            rod(p + (0, 0.15 * long, low - 1), p + (0, 0.15 * long, low + 1), 0.018)
            for p in corners(1.15 * radius, 0.33 * long)
        ]
        for hole in holes:
            foot -= hole
        return [*solids, foot, box((0, 0.15 * long, low / 2), (wide, 0.7 * long, -low))]
    ring = disc(1.5 * radius, 0.0, 0.04) - disc(0.3 * radius, -1.0, 1.0)
    drilled = bolts(6, 1.3 * radius, 0.1 * radius, -0.02, 0.06)
    return [*solids, *_along_y([ring, *drilled], (0, 0.72 * long, 0))]


def _split_housing(rng: Rng) -> Solids:
    """Cast halves bolted at the shafts' level, bearing caps, ribs and feet."""
    stages = int(rng.integers(2, 4))
    long, wide = 0.28 * stages + rng.uniform(0.1, 0.2), rng.uniform(0.26, 0.4)
    lower, upper = rng.uniform(0.24, 0.34), rng.uniform(0.14, 0.26)
    radii = np.linspace(0.075, 0.12, stages)
    centres = np.linspace(-0.5, 0.5, stages) * (long - 0.3)
    solids = [box((0, 0, lower / 2), (long, wide, lower), 0.02)]
    slope = rng.uniform(0.0, 0.2)
    roof = [(x, y, lower) for x in (-0.47 * long, 0.47 * long) for y in (-wide, wide)]
    for x, drop in ((-0.4, slope), (0.4, 0.0)):
        for y in (-0.9 * wide, 0.9 * wide):
            roof.append((x * long, y, lower + upper * (1 - drop)))
    solids.append(Manifold.hull_points(np.array(roof) * (1, 0.48, 1)))
    rim = box((0, 0, lower), (long + 0.1, wide + 0.1, 0.05), 0.008)
    solids += [rim, box((0, 0, 0.02), (long + 0.06, wide + 0.16, 0.045))]
    for x in np.linspace(-0.5, 0.5, 5) * (long + 0.04):
        for y in (-wide / 2 - 0.025, wide / 2 + 0.025):
            low, high = (x, y, lower - 0.04), (x, y, lower + 0.045)
            solids.append(rod(low, high, 0.014, segments=6))
    through = rng.random() < 0.5
    for index, (x, radius) in enumerate(zip(centres, radii, strict=True)):
        for side in (-1, 1):
            is_end = through or side == (1 if index == 0 else -1)
            has_shaft = index in (0, stages - 1) and is_end
            cap = _bearing_cap(rng, radius, wide / 2 + 0.08, has_shaft)
            if side < 0:
                cap = [part.rotate((180, 0, 0)) for part in cap]
            solids += _along_y(cap, (x, 0, lower))
        for side in (-1, 1):
            if rng.random() < 0.8:
                rib = (x, side * (wide / 2 + 0.025), lower / 2)
                solids.append(box(rib, (0.025, 0.06, lower)))
    if rng.random() < 0.6:
        eye = torus(0.035, 0.012, segments=16).rotate((90, 0, 0))
        for x in (-0.25 * long, 0.25 * long):
            solids.append(eye.translate((x, 0, lower + upper * (1 - slope) + 0.015)))
        solids.append(box((0, 0, lower + upper * 0.85), (0.62 * long, 0.05, 0.1)))
    solids.append(
        rod((0.3 * long, 0, lower), (0.3 * long, 0, lower + upper + 0.05), 0.025)
    )
    return solids


def _bearing_cap(rng: Rng, radius: float, end: float, has_shaft: bool) -> Solids:
    """A bolted cover about z, as far as `end`, and the shaft through it in some."""
    cap = [disc(radius, 0.0, end - 0.02), disc(0.7 * radius, 0.0, end)]
    cap += bolts(6, 0.85 * radius, 0.01, 0.0, end - 0.008)
    return cap + (
        _shaft(rng, 0.42 * radius, end - 0.02, end + 0.14) if has_shaft else []
    )


def _right_angle(rng: Rng) -> Solids:
    """Box with shafts out of two or three of its faces, each on a round flange."""
    side = rng.uniform(0.26, 0.36)
    solids = [box((0, 0, 0), (side, side, side * rng.uniform(0.9, 1.3)), 0.03)]
    ports = [(0, 1), (1, 0), (0, -1), (-1, 0)][: int(rng.integers(2, 5))]
    has_motor = rng.random() < 0.5
    for index, (x, y) in enumerate(ports):
        radius, end = side * rng.uniform(0.32, 0.44), side * 0.5
        parts = [disc(radius, 0.0, end + 0.04), disc(0.7 * radius, 0.0, end + 0.08)]
        parts += bolts(4, 0.83 * radius, 0.013, end, end + 0.055)
        if index == 1 and has_motor:
            parts += [
                part.translate((0, 0, end + 0.06))
                for part in motor(rng, 0.45 * side, rng.uniform(0.3, 0.42))
            ]
        else:
            parts += _shaft(rng, 0.13 * side, end + 0.06, end + 0.24)
        turn = float(np.degrees(np.arctan2(-x, y)))
        solids += [part.rotate((-90, 0, turn)) for part in parts]
    foot = rng.random() < 0.6
    if foot:
        solids.append(box((0, 0, -0.62 * side), (1.35 * side, 1.35 * side, 0.045)))
        solids.append(box((0, 0, -0.5 * side), (side * 0.9, side * 0.9, 0.26 * side)))
        for point in corners(0.59 * side, 0.59 * side):
            low = point - (0, 0, 0.62 * side)
            solids.append(rod(low, low + (0, 0, 0.045), 0.02, segments=6))
    if rng.random() < 0.5:
        solids.append(disc(0.34 * side, 0.4 * side, 0.7 * side, 24))
    return solids


def _worm(rng: Rng) -> Solids:
    """Round wheel case with the output through it, above or below the worm's barrel,
    which carries the motor or its shaft."""
    radius, deep = rng.uniform(0.15, 0.22), rng.uniform(0.14, 0.2)
    barrel = radius * rng.uniform(0.42, 0.55)
    offset = (radius + 0.35 * barrel) * rng.choice([-1, 1])
    case = [disc(radius, -deep / 2, deep / 2, 36)]
    case += [disc(0.75 * radius, -0.62 * deep, 0.62 * deep)]
    for side in (0, 180):
        case += [
            b.rotate((side, 0, 0))
            for b in bolts(6, 0.85 * radius, 0.014, 0.0, 0.56 * deep)
        ]
    out = _shaft(rng, 0.26 * radius, 0.6 * deep, 0.6 * deep + 0.16)
    hollow = rng.random() < 0.4
    case += [] if hollow else out
    if not hollow and rng.random() < 0.3:
        case += [part.rotate((180, 0, 0)) for part in out]
    solids = _along_y(case, (0, 0, 0))
    size = (2.1 * radius, deep * 0.9, 1.2 * radius)
    solids.append(box((0, 0, offset * 0.45), size, 0.02))
    half = 1.15 * radius
    worm = [disc(barrel, -half, half), disc(1.15 * barrel, half - 0.03, half + 0.02)]
    if rng.random() < 0.7:
        drive = motor(rng, barrel * rng.uniform(1.0, 1.4), rng.uniform(0.26, 0.4))
        worm += [part.rotate((0, 0, 180)).translate((0, 0, half)) for part in drive]
    else:
        worm += _shaft(rng, 0.32 * barrel, half, half + 0.14)
    place = (0, 0, float(offset))
    solids += [part.rotate((0, 90, 0)).translate(place) for part in worm]
    if hollow:
        bore = rod((0, -1, 0), (0, 1, 0), 0.3 * radius)
        solids = [solid - bore for solid in solids]
    low = -radius - (1.4 * barrel if offset < 0 else 0.1 * radius)
    if rng.random() < 0.7:
        for y in (-0.62 * deep, 0.62 * deep):
            solids.append(box((0, y, low), (2.4 * radius, 0.09, 0.04)))
        for x in (-0.85 * radius, 0.85 * radius):
            solids.append(box((x, 0, low / 2), (0.05, deep, -low)))
            solids.append(box((x, 0, low + 0.01), (0.08, 1.5 * deep, 0.06)))
    return solids


def _planetary(rng: Rng) -> Solids:
    """Coaxial drums of one to four stages standing on the output's flange or lying."""
    radius, level, parts = rng.uniform(0.13, 0.2), 0.0, []
    flange, square = rng.uniform(1.2, 1.5) * radius, rng.random() < 0.4
    if square:
        side = 2.1 * radius
        parts.append(box((0, 0, 0.025), (side, side, 0.05), 0.01))
        parts += bolts(4, 1.3 * radius, 0.02, 0.02, 0.075)
    else:
        parts.append(disc(flange, 0.0, 0.045, 36))
        parts += bolts(int(rng.integers(6, 13)), 0.88 * flange, 0.017, 0.02, 0.07)
    size = radius
    for _ in range(int(rng.integers(1, 5))):
        tall = rng.uniform(0.08, 0.16)
        parts.append(disc(size, level, level + tall, 36))
        parts.append(disc(1.07 * size, level + tall - 0.025, level + tall + 0.004, 36))
        level, size = level + tall, size * rng.uniform(0.8, 0.97)
    parts += [p.rotate((180, 0, 0)) for p in _shaft(rng, 0.32 * radius, -0.01, 0.15)]
    parts.append(disc(0.55 * radius, -0.04, 0.02))
    if rng.random() < 0.65:
        drive = motor(rng, 0.85 * size, rng.uniform(0.2, 0.34))
        parts += [p.translate((0, 0, level)) for p in drive]
    else:
        parts.append(disc(0.8 * size, level, level + 0.03))
        parts.append(disc(0.2 * radius, level, level + 0.12))
    if rng.random() < 0.6:
        parts = [part.rotate((90, 0, 0)) for part in parts]
        if rng.random() < 0.5:
            low = -1.25 * flange
            parts.append(box((0, -0.03, low / 2), (0.9 * radius, 0.06, -low)))
            parts.append(box((0, -0.1, low), (2 * radius, 0.34, 0.04)))
    return parts
