"""Procedural forklifts, stackers and pallet trucks, forks to the front."""

import numpy as np

from experiments.simulation.solids import (
    Rng,
    Solids,
    assembled,
    bar,
    box,
    capsule,
    one_of,
    rod,
    side_profile,
    tube_along,
)


def forklift(rng: Rng) -> Solids:
    """Trucks with a seat and a counterweight, walked stackers, hand pallet trucks."""
    return assembled(one_of(rng, (_seated, _stacker, _hand_truck), (0.46, 0.27, 0.27)))


def _wheel(
    center: np.ndarray, radius: float, wide: float, segments: int = 24
) -> Solids:
    across = np.array((wide / 2, 0, 0))
    tyre = rod(center - across, center + across, radius, segments=segments)
    dish = rod(center + 0.7 * across, center + 2 * across, 0.55 * radius)
    other = rod(center - 2 * across, center - 0.7 * across, 0.55 * radius)
    bolt = rod(center - 1.1 * across, center + 1.1 * across, 0.22 * radius)
    return [tyre - dish - other, bolt]


def _forks(
    y: float, level: float, long: float, spread: float, wide: float, tall: float
) -> Solids:
    """Two tapered tines whose shanks rise from y."""
    tine = np.array(
        [(0, 0), (long, 0.012), (long, 0.022), (0.06, 0.05), (0.05, tall), (0, tall)]
    )
    solid = side_profile(tine, wide)
    return [solid.translate((x, y, level)) for x in (-spread, spread)]


def _mast(
    rng: Rng, y: float, half: float, tall: float, stages: int, low: float = 0.08
) -> tuple[Solids, float, float]:
    """Nested uprights with cross members and lift cylinders, extended in some; half the
    distance between the innermost uprights, and the height of their feet."""
    solids, thick = [], rng.uniform(0.06, 0.08)
    raised = rng.uniform(0.0, 0.4) * tall * (rng.random() < 0.5)
    for stage in range(stages):
        inner, shift = half - 0.65 * stage * thick, y - 0.03 * stage
        bottom = low + stage * raised
        for x in (-inner, inner):
            start, end = (x, shift, bottom), (x, shift, bottom + tall)
            solids.append(bar(start, end, 0.7 * thick, 1.6 * thick))
        for share in (0.97, 0.5) if stage == 0 else (0.97, 0.05):
            beam = (0, shift - 0.5 * thick, bottom + share * tall)
            solids.append(box(beam, (2 * inner, 0.7 * thick, thick)))
    for x in [-0.4 * half, 0.4 * half] if rng.random() < 0.6 else [0.0]:
        foot, joint = (x, y - 0.05, low + 0.02), (x, y - 0.05, low + 0.6 * tall)
        solids.append(rod(foot, joint, 0.035, segments=14))
        solids.append(rod(joint, (x, y - 0.05, low + 0.95 * tall), 0.02, segments=10))
    solids.append(box((0, y - 0.05, low + 0.04), (2 * half, 0.12, 0.08)))
    return solids, inner, bottom


def _carriage(rng: Rng, y: float, level: float, half: float, inner: float) -> Solids:
    """Two plates across the mast, held by its innermost uprights at +-`inner`, and a
    load guard in some."""
    solids = [box((0, y, level + z), (2 * half, 0.05, 0.09)) for z in (0.06, 0.4)]
    for x in (-inner, inner):
        solids.append(box((x, y - 0.05, level + 0.23), (0.06, 0.12, 0.42)))
    if rng.random() < 0.6:
        tall = rng.uniform(0.5, 0.8)
        for x in np.linspace(-0.92, 0.92, int(rng.integers(4, 8))) * half:
            solids.append(box((x, y, level + 0.4 + tall / 2), (0.025, 0.03, tall)))
        solids.append(box((0, y, level + 0.4 + tall), (1.9 * half, 0.035, 0.05)))
    return solids


def _seated(rng: Rng) -> Solids:
    """Body with counterweight, seat and steering wheel under a guard, mast in front."""
    half, long = rng.uniform(0.42, 0.55), rng.uniform(1.3, 1.7)
    wheel, rear = rng.uniform(0.24, 0.32), rng.uniform(0.18, 0.24)
    deck, hood = rng.uniform(0.4, 0.5), rng.uniform(0.85, 1.0)
    back, front = -long / 2, long / 2
    slope = rng.uniform(0.02, 0.2)
    weight = np.array(
        [
            (back, 0.3),
            (back + 0.55, 0.12),
            (back + 0.55, hood),
            (back + 0.1 + slope, hood),
            (back - 0.04, hood - rng.uniform(0.15, 0.35)),
        ]
    )
    solids = [side_profile(weight, 2 * half)]
    seat, cowl = back + rng.uniform(0.65, 0.8), front - 0.12
    solids.append(
        box((0, back + 0.6, (hood + 0.15) / 2), (1.7 * half, 0.5, hood - 0.15))
    )
    solids.append(box((0, 0.15, deck - 0.12), (1.9 * half, long - 0.4, 0.26)))
    dash = [(cowl - 0.1, deck), (cowl + 0.1, deck), (cowl + 0.1, hood), (cowl, hood)]
    solids.append(side_profile(np.array(dash), 1.7 * half))
    solids.append(box((0, seat, hood + 0.05), (0.5, 0.48, 0.14), 0.04))
    solids.append(bar((0, seat - 0.2, hood), (0, seat - 0.32, hood + 0.5), 0.46, 0.1))
    foot, top = (0, cowl - 0.03, hood - 0.1), (0, cowl - 0.22, hood + 0.14)
    solids.append(rod(foot, top, 0.025, segments=10))
    solids.append(rod(top, np.add(top, (0, -0.02, 0.022)), 0.16, segments=20))
    solids += _guard(rng, half, back, cowl, hood)
    for x in (-half + 0.06, half - 0.06):
        solids += _wheel(np.array((x, front - 0.15, wheel)), wheel, 0.18)
        solids += _wheel(np.array((x * 0.94, back + 0.32, rear)), rear, 0.15)
        solids.append(box((x, front - 0.2, 2 * wheel + 0.02), (0.2, 2.1 * wheel, 0.04)))
    solids.append(rod((-half, front - 0.15, wheel), (half, front - 0.15, wheel), 0.07))
    solids.append(rod((-half, back + 0.32, rear), (half, back + 0.32, rear), 0.05))
    mast, tall = front + 0.16, rng.uniform(1.8, 2.2)
    uprights, inner, bottom = _mast(rng, mast, 0.36, tall, int(rng.integers(2, 4)))
    solids += uprights
    solids.append(box((0, front, wheel + 0.05), (0.5, 0.4, 0.16)))
    for x in (-0.34, 0.34):
        ends = (x, front - 0.3, hood - 0.15), (x, mast - 0.02, hood + 0.1)
        solids.append(rod(*ends, 0.03, segments=10))
    level, fork = bottom + rng.choice([-0.04, rng.uniform(0.0, 0.6)]), mast + 0.11
    solids += _carriage(rng, mast + 0.1, level, rng.uniform(0.42, 0.55), inner)
    spread = rng.uniform(0.2, 0.34)
    return solids + _forks(fork, level, rng.uniform(0.9, 1.2), spread, 0.11, 0.5)


def _guard(rng: Rng, half: float, back: float, cowl: float, hood: float) -> Solids:
    """Posts and a barred roof over the driver, or a closed cab's walls."""
    roof, thick = rng.uniform(2.0, 2.2), rng.uniform(0.045, 0.06)
    half, rear = 0.86 * half, back + 0.35
    lean, solids = rng.uniform(0.05, 0.3), []
    for x in (-half, half):
        solids.append(bar((x, cowl, hood - 0.1), (x, cowl - lean, roof), thick, thick))
        solids.append(bar((x, rear, hood - 0.1), (x, rear + 0.1, roof), thick, thick))
        rail = (x, rear + 0.05, roof), (x, cowl - lean + 0.05, roof)
        solids.append(bar(*rail, thick, thick))
    middle, deep = (rear + cowl - lean) / 2 + 0.05, cowl - lean - rear
    if rng.random() < 0.3:
        solids.append(box((0, middle, roof + 0.01), (2.1 * half, deep + 0.1, 0.05)))
        pane = (roof + hood) / 2
        solids.append(box((0, rear + 0.07, pane), (2 * half, 0.02, roof - hood)))
    else:
        for y in np.linspace(-0.48, 0.48, int(rng.integers(5, 9))) * deep:
            solids.append(box((0, middle + y, roof), (2 * half, 0.035, 0.035)))
    if rng.random() < 0.6:
        lamp = np.array((0.6 * half, rear + 0.12, roof))
        solids.append(rod(lamp, lamp + (0, 0, 0.12), 0.045, segments=14))
    for x in (-0.8 * half, 0.8 * half):
        light = np.array((x, cowl - lean + 0.03, roof - 0.08))
        solids.append(rod(light - (0, 0.06, 0), light + (0, 0.06, 0), 0.06, 0.07, 16))
    return solids


def _tiller(
    rng: Rng, root: np.ndarray, tilt: float, long: float, wide: float
) -> Solids:
    """A steering bar that leans back from its foot, and the loop at its end."""
    along = np.array((0.0, -np.sin(tilt), np.cos(tilt)))
    end = root + long * along
    solids, loop = [rod(root, end, 0.022, segments=12)], 0.16 * along
    points = [end, end + (-wide, 0, 0) + 0.4 * loop, end + (-wide, 0, 0) + loop]
    points += [end + (wide, 0, 0) + loop, end + (wide, 0, 0) + 0.4 * loop, end]
    solids += tube_along(np.array(points), 0.016, 10)
    if rng.random() < 0.5:
        lever = end + (0.02, 0, 0) + 0.5 * loop
        solids.append(capsule(end, lever + (0.4 * wide, 0, 0), 0.01))
    return solids


def _stacker(rng: Rng) -> Solids:
    """A mast on a drive unit that is walked behind, over two outriggers."""
    half, deep = rng.uniform(0.36, 0.42), rng.uniform(0.45, 0.65)
    tall, hood = rng.uniform(1.6, 2.1), rng.uniform(0.7, 0.9)
    body = np.array(
        [
            (-deep, 0.08),
            (0, 0.08),
            (0, hood),
            (-0.5 * deep, hood),
            (-deep, hood - rng.uniform(0.05, 0.3)),
        ]
    )
    solids = [side_profile(body, 2 * half)]
    uprights, inner, bottom = _mast(rng, 0.1, 0.8 * half, tall, 2, 0.06)
    solids += uprights
    long, spread = rng.uniform(0.9, 1.1), rng.uniform(0.2, 0.27)
    level = bottom + rng.choice([0.02, rng.uniform(0.02, 0.8)])
    solids += _carriage(rng, 0.22, level, 0.95 * half, inner)
    solids += _forks(0.24, level, long, spread, 0.16, 0.4)
    outer = spread if level > 0.12 and rng.random() < 0.6 else half + 0.06
    for x in (-outer, outer):
        solids.append(box((x, 0.5 * long, 0.05), (0.11, long + 0.3, 0.06)))
        center = np.array((x, 0.92 * long, 0.04))
        solids.append(rod(center - (0.04, 0, 0), center + (0.04, 0, 0), 0.04))
    solids.append(box((0, 0.08, 0.09), (2 * outer + 0.1, 0.2, 0.12)))
    center = np.array((0.0, -0.6 * deep, 0.11))
    solids += _wheel(center, 0.11, 0.08)
    for x in (-0.85 * half, 0.85 * half):
        center = np.array((x, -0.7 * deep, 0.06))
        solids.append(rod(center - (0.025, 0, 0), center + (0.025, 0, 0), 0.06))
    root = np.array((0.0, -0.9 * deep, hood - 0.25))
    solids.append(box(root, (0.14, 0.16, 0.16), 0.02))
    solids += _tiller(rng, root, rng.uniform(0.2, 0.9), rng.uniform(0.5, 0.7), 0.13)
    if rng.random() < 0.4:
        screen = (0, 0.12, (hood + tall) / 2)
        solids.append(box(screen, (1.6 * half, 0.015, tall - hood + 0.1)))
    if rng.random() < 0.5:
        size = (1.2 * half, 0.35 * deep, rng.uniform(0.05, 0.2))
        solids.append(box((0, -0.4 * deep, hood), size, 0.02))
    return solids


def _hand_truck(rng: Rng) -> Solids:
    """Low forks on rollers, a jack with a tiller; scissors under some."""
    long, spread = rng.uniform(0.95, 1.2), rng.uniform(0.18, 0.22)
    wide, level = rng.uniform(0.15, 0.18), rng.uniform(0.07, 0.16)
    front, solids = long, []
    tip = np.array(
        [(0, -0.05), (0.85 * front, -0.05), (front, -0.015), (front, 0.01), (0, 0.01)]
    )
    for x in (-spread, spread):
        solids.append(side_profile(tip, wide).translate((x, 0, level)))
        for y in (0.78, 0.86) if rng.random() < 0.5 else (0.82,):
            center = np.array((x, y * front, 0.04))
            ends = center - (0.04, 0, 0), center + (0.04, 0, 0)
            solids.append(rod(*ends, 0.04, segments=18))
        arm = (x, 0.87 * front, 0.04), (x, 0.55 * front, level - 0.02)
        solids.append(bar(*arm, 0.07, 0.025))
    tall = rng.uniform(0.25, 0.36)
    solids.append(box((0, 0.03, level), (2 * spread + wide, 0.1, 0.07)))
    slant = [
        (-0.02, level - 0.03),
        (0.08, level),
        (0.0, level + tall),
        (-0.06, level + tall),
    ]
    solids.append(side_profile(np.array(slant), 2 * spread))
    pump = np.array((0.0, -0.1, 0.1))
    solids.append(rod(pump, pump + (0, 0, tall + level), 0.045, segments=18))
    solids.append(rod(pump + (0, 0, 0.02), pump + (0, 0, 0.18), 0.075, segments=20))
    solids.append(box((0, -0.05, level + 0.9 * tall), (0.16, 0.2, 0.06)))
    solids.append(box((0, -0.02, 0.2), (0.3, 0.2, 0.05)))
    solids.append(rod((-0.1, -0.1, 0.09), (0.1, -0.1, 0.09), 0.02, segments=10))
    for x in (-0.075, 0.075):
        center = np.array((x, -0.1, 0.09))
        solids += _wheel(center, 0.09, 0.05, 22)
    tilt, root = rng.uniform(0.05, 1.0), pump + (0, 0, 0.24)
    solids.append(box(root, (0.12, 0.09, 0.1), 0.01))
    return solids + _tiller(rng, root, tilt, rng.uniform(0.75, 0.95), 0.1)
