"""Procedural valves, and the flanges and hand wheels that pipe runs borrow.

The pipe lies along x, the stem points up.
"""

import numpy as np

from experiments.simulation.solids import (
    Rng,
    Solids,
    Vector,
    assembled,
    axes_along,
    ball,
    bar,
    box,
    capsule,
    lathe,
    place,
    ring_of,
    rod,
    torus,
    tube,
    union,
)

TURNING_DRIVES = {"lever": 0.4, "rack": 0.3, "motor": 0.15, "gear": 0.15}
LIFTING_DRIVES = {"wheel": 0.4, "diaphragm": 0.22, "motor": 0.13, "rising": 0.25}
"""What moves the stem of which valves, and how often."""


def flange(
    point: Vector,
    axis: Vector,
    radius: float,
    thick: float,
    count: int = 0,
    bore: float = 0.0,
) -> Solids:
    """Disc from `point` along `axis`, with so many bolts right through it and a hole
    of the radius `bore` where that is positive."""
    start, axis = np.asarray(point, float), np.asarray(axis, float)
    solids = [tube(start, start + thick * axis, radius, bore, 16)]
    if count:
        low, high = (0.8 * radius, 0, -0.4 * thick), (0.8 * radius, 0, 1.4 * thick)
        heads = ring_of(rod(low, high, 0.11 * radius, segments=6), count, 180 / count)
        solids += [place(head, axes_along(axis), start) for head in heads]
    return solids


def hand_wheel(rng: Rng, radius: float, level: float, segments: int = 20) -> Solids:
    """Rim, spokes and hub about z at a height."""
    thick, spokes = 0.1 * radius, int(rng.integers(3, 6))
    drop = rng.choice([0.0, 0.25 * radius])
    spoke = rod((0, 0, level - drop), (radius, 0, level), 0.6 * thick, segments=6)
    low, high = level - drop - thick, level - drop + 1.6 * thick
    hub = rod((0, 0, low), (0, 0, high), 2 * thick, segments=12)
    rim = torus(radius, thick, segments=segments, around=6).translate((0, 0, level))
    return [rim, hub, *ring_of(spoke, spokes)]


def valve(rng: Rng) -> Solids:
    """Gate, globe, ball, butterfly, angle and three-way bodies with flanged, screwed
    or plain ends under wheels, levers and actuators."""
    bore = rng.uniform(0.05, 0.085)
    kinds = ["gate", "globe", "ball", "butterfly", "angle", "three_way"]
    kind = str(rng.choice(kinds, p=[0.22, 0.2, 0.22, 0.14, 0.11, 0.11]))
    half = bore * rng.uniform(2.0, 3.0)
    solids, top = _body(rng, kind, bore, half)
    ports = [(1, 0, 0), (-1, 0, 0)]
    if kind == "angle":
        ports = [(1, 0, 0), (0, 0, -1)]
    elif kind == "three_way":
        ports.append((0, 1, 0) if rng.random() < 0.6 else (0, 0, -1))
    if kind != "butterfly":
        solids += _ends(rng, ports, bore, half)
    turning = kind in ("ball", "butterfly", "three_way")
    drives = TURNING_DRIVES if turning else LIFTING_DRIVES
    drive = str(rng.choice(list(drives), p=list(drives.values())))
    solids += _operator(rng, drive, bore, top)
    if kind == "butterfly":
        plate = rod((-0.1 * bore, 0, 0), (0.1 * bore, 0, 0), 1.65 * bore)
        hole = rod((-bore, 0, 0), (bore, 0, 0), 1.6 * bore, segments=28)
        plate = plate.rotate((0, 0, rng.uniform(0, 80)))
        return assembled([union(solids) - hole, plate])
    outs = half * np.array(ports, float)
    holes = [rod(0.25 * out, 1.02 * out, 0.8 * bore) for out in outs]
    return assembled([union(solids) - union(holes)])


def _body(rng: Rng, kind: str, bore: float, half: float) -> tuple[Solids, float]:
    """The housing about the origin, and the height of its top."""
    wide = 1.25 * bore
    across = rod((-half, 0, 0), (half, 0, 0), wide)
    if kind == "butterfly":
        outer, thick = 2.4 * bore, 0.5 * bore
        solids = [rod((-thick, 0, 0), (thick, 0, 0), outer, segments=32)]
        if rng.random() < 0.6:
            lug = rod(
                (-1.15 * thick, 0, 0), (1.15 * thick, 0, 0), 0.4 * bore, segments=12
            )
            for angle in np.radians(np.arange(8) * 45 + 22.5):
                spot = 2.5 * bore * np.array((0, np.cos(angle), np.sin(angle)))
                solids.append(lug.translate(spot))
        solids.append(rod((0, 0, 2 * bore), (0, 0, 3.6 * bore), 0.55 * bore))
        solids.append(rod((0, 0, -2.2 * bore), (0, 0, -2.8 * bore), 0.5 * bore))
        return solids, 3.5 * bore
    if kind == "gate":
        tall = bore * rng.uniform(2.2, 3.2)
        body = [ball((0, 0, 0), (1.5 * bore, 1.7 * bore, 1.7 * bore), 24)]
        body.append(bar((0, 0, -bore), (0, 0, tall), 1.7 * bore, 3.0 * bore))
        solids = [across, *body]
        solids += _bonnet(rng, 1.9 * bore, tall)
        return solids, tall + 1.2 * bore
    if kind == "ball":
        return [across, *_ball_body(rng, bore, half)], 2.3 * bore
    if kind == "globe":
        body = [ball((0, 0, 0), (1.8 * bore, 1.9 * bore, 1.9 * bore), 28)]
        body.append(ball((0, 0, 0), (0.94 * half, 1.5 * bore, 1.5 * bore), 24))
    elif kind == "angle":
        body = [ball((0, 0, 0), 1.75 * bore, 28), rod((0, 0, 0), (half, 0, 0), wide)]
        body.append(rod((0, 0, 0), (0, 0, -half), wide))
        across = body[1]
    else:
        body = [rod((0, 0, -1.5 * bore), (0, 0, 1.7 * bore), 1.9 * bore, segments=28)]
    neck = rod((0, 0, bore), (0, 0, 2.4 * bore), 1.3 * bore)
    solids = [across, *body, neck, *_bonnet(rng, 1.7 * bore, 2.2 * bore)]
    return solids, 3.3 * bore


def _ball_body(rng: Rng, bore: float, half: float) -> Solids:
    style = rng.choice(["round", "hex", "block"])
    if style == "round":
        body = ball((0, 0, 0), (1.7 * bore, 1.75 * bore, 1.75 * bore), 28)
    elif style == "hex":
        body = rod((-0.7 * half, 0, 0), (0.7 * half, 0, 0), 1.7 * bore, segments=6)
    else:
        body = box((0, 0, 0), (1.3 * half, 3.2 * bore, 3.2 * bore), 0.5 * bore)
    return [body, rod((0, 0, bore), (0, 0, 2.4 * bore), 0.6 * bore)]


def _bonnet(rng: Rng, radius: float, level: float) -> Solids:
    """Bolted cover, and the neck that carries the stem."""
    thick, count = 0.22 * radius, int(rng.choice([0, 4, 6, 8]))
    plates = flange((0, 0, level), (0, 0, 1), radius, thick, count)
    plates += flange((0, 0, level - thick), (0, 0, 1), radius, thick)
    dome = lathe(
        [
            (0.75 * radius, 0),
            (0.6 * radius, 0.35 * radius),
            (0.35 * radius, 0.6 * radius),
        ]
    )
    return [*plates, dome.translate((0, 0, level + thick - 0.002))]


def _ends(rng: Rng, ports: list, bore: float, half: float) -> Solids:
    style = rng.choice(["flanged", "hex", "plain"], p=[0.6, 0.25, 0.15])
    solids, count = [], int(rng.choice([0, 4, 6, 8]))
    radius, thick = bore * rng.uniform(1.9, 2.4), 0.3 * bore
    for port in ports:
        out = np.array(port, float)
        solids.append(rod((0, 0, 0), half * out, 1.25 * bore))
        if style == "flanged":
            solids += flange((half - thick) * out, out, radius, thick, count)
        elif style == "hex":
            ends = (half - 0.9 * bore) * out, half * out
            solids.append(rod(*ends, 1.6 * bore, segments=6))
        else:
            ends = (half - 0.3 * bore) * out, half * out
            solids.append(rod(*ends, 1.4 * bore))
    return solids


def _operator(rng: Rng, drive: str, bore: float, top: float) -> Solids:
    """What turns or lifts the stem, from the height `top` up."""
    rise = bore * rng.uniform(1.0, 2.5)
    stem = rod((0, 0, top - bore), (0, 0, top + rise), 0.3 * bore, segments=14)
    level, turn = top + rise, float(rng.uniform(0, 360))
    if drive == "lever":
        low, reach = top + 0.4 * bore, bore * rng.uniform(4.0, 6.5)
        start, knee = np.array((0, 0, low)), np.array((1.2 * bore, 0, low + 0.5 * bore))
        lever = [bar(start, knee, 0.5 * bore, 0.25 * bore)]
        lever.append(bar(knee, (reach, 0, knee[2]), 0.6 * bore, 0.22 * bore))
        lever.append(rod(start - (0, 0, bore), start + (0, 0, 0.3 * bore), 0.5 * bore))
        if rng.random() < 0.5:
            grip = (0.6 * reach, 0, knee[2]), (reach, 0, knee[2])
            lever.append(capsule(*grip, 0.32 * bore))
        angle = float(rng.choice([0, 90, 180, turn]))
        return [part.rotate((0, 0, angle)) for part in lever]
    if drive in ("wheel", "rising"):
        wheel = hand_wheel(rng, bore * rng.uniform(1.8, 3.0), level)
        solids = [stem, *(part.rotate((0, 0, turn)) for part in wheel)]
        if drive == "rising":
            for side in (-1, 1):
                foot = (0, side * bore, top - 0.8 * bore)
                head = (0, side * 0.45 * bore, level - 0.2 * bore)
                solids.append(bar(foot, head, 0.4 * bore, 0.3 * bore))
            tip = level + bore * rng.uniform(1.0, 3.0)
            solids.append(rod((0, 0, level), (0, 0, tip), 0.25 * bore, segments=12))
        return solids
    bracket = []
    for side in (-1, 1):
        foot, head = (side * 0.9 * bore, 0, top - bore), (side * 0.9 * bore, 0, level)
        bracket.append(bar(foot, head, 0.25 * bore, 1.2 * bore))
    bracket.append(box((0, 0, top - 0.2 * bore), (2 * bore, 1.4 * bore, 0.3 * bore)))
    mount = [stem, *bracket, box((0, 0, level), (2.4 * bore, 1.6 * bore, 0.3 * bore))]
    angle = float(rng.choice([0, 90]))
    return mount + [
        part.rotate((0, 0, angle)) for part in _actuator(rng, drive, bore, level)
    ]


def _actuator(rng: Rng, drive: str, bore: float, level: float) -> Solids:
    """Diaphragm case, rack-and-pinion cylinder, electric drive, or gear with wheel."""
    if drive == "diaphragm":
        radius = bore * rng.uniform(2.4, 3.4)
        profile = [
            (0.5, 0),
            (0.93, 0.18),
            (1, 0.2),
            (1, 0.32),
            (0.93, 0.34),
            (0.4, 0.6),
        ]
        case = lathe([(radius * r, radius * z) for r, z in profile])
        crown = rod((0, 0, 0.55 * radius), (0, 0, 0.8 * radius), 0.25 * radius)
        rim = rod(
            (0.93 * radius, 0, 0.14 * radius),
            (0.93 * radius, 0, 0.38 * radius),
            0.05 * radius,
            segments=6,
        )
        parts = [case, crown, *ring_of(rim, 10)]
        return [part.translate((0, 0, level - 0.002)) for part in parts]
    if drive == "rack":
        reach, size = bore * rng.uniform(2.6, 4.2), bore * rng.uniform(1.1, 1.5)
        high = level + size
        body = rod((-reach, 0, high), (reach, 0, high), size)
        block = box((0, 0, high), (1.2 * reach, 2.1 * size, 2.0 * size), 0.1 * size)
        caps = [
            box((s * reach, 0, high), (0.5 * size, 2.1 * size, 2.1 * size), 0.2 * size)
            for s in (-1, 1)
        ]
        knob = rod((0, 0, high), (0, 0, high + 1.5 * size), 0.4 * size)
        return [body, block, *caps, knob]
    return (_gear if drive == "gear" else _electric)(rng, bore, level)


def _gear(rng: Rng, bore: float, level: float) -> Solids:
    case = rod((0, 0, level), (0, 0, level + bore), 1.3 * bore, segments=28)
    middle = np.array((0, 1.1 * bore, level + 0.5 * bore))
    worm = rod(middle - (1.5 * bore, 0, 0), middle + (2.6 * bore, 0, 0), 0.4 * bore)
    wheel = hand_wheel(rng, bore * rng.uniform(1.4, 2.2), 0.0)
    end = middle + (2.5 * bore, 0, 0)
    return [case, worm, *(part.rotate((0, 90, 0)).translate(end) for part in wheel)]


def _electric(rng: Rng, bore: float, level: float) -> Solids:
    size = bore * rng.uniform(1.3, 1.8)
    high = level + size
    case = rod((0, 0, level), (0, 0, level + 2.2 * size), size, segments=28)
    drum = rod((0, 0, high), (2.6 * size, 0, high), 0.75 * size)
    cover = box((-size, 0, high), (1.2 * size, 1.4 * size, 1.4 * size), 0.2 * size)
    axle = rod((0, 0, high), (0, 1.6 * size, high), 0.2 * size)
    wheel = hand_wheel(rng, size * rng.uniform(0.8, 1.1), 0.0)
    end = (0, 1.5 * size, high)
    turned = [part.rotate((-90, 0, 0)).translate(end) for part in wheel]
    return [case, drum, cover, axle, *turned]
