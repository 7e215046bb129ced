"""Procedural monitors."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import (
    Rng,
    assembled,
    bar,
    box,
    lathe,
    prism,
    rod,
    side_profile,
    tube_along,
)


def monitor(rng: Rng) -> list[Manifold]:
    """Flat, curved, tube, all-in-one, portrait, double; several stands. The screen
    faces +y."""
    kind = str(
        rng.choice(
            ["flat", "bulged", "curved", "tube", "all_in_one", "portrait", "double"],
            p=[0.22, 0.16, 0.16, 0.14, 0.1, 0.1, 0.12],
        )
    )
    aspect, width = rng.choice([1.25, 1.33, 1.6, 1.78]), rng.uniform(0.42, 0.75)
    if kind == "tube":
        return _tube_monitor(rng, rng.uniform(0.34, 0.46))
    if kind == "curved":
        width, aspect = rng.uniform(0.7, 1.0), rng.uniform(1.9, 2.5)
    if kind == "portrait":
        width, aspect = 0.36, 0.6
    tall = width / aspect
    lift, tilt = tall / 2 + rng.uniform(0.06, 0.2), rng.uniform(-4, 16)
    head = _panel(rng, kind, width, tall)
    head = [part.rotate((tilt, 0, 0)).translate((0, 0, lift)) for part in head]
    if kind == "double":
        return assembled(
            [*_pair(rng, head, width, lift), *_stand(rng, 1.3 * width, lift, 0.07)]
        )
    if kind == "flat" and width > 0.6 and rng.random() < 0.5:
        slope = np.sin(np.radians(tilt))
        for x in (-0.36 * width, 0.36 * width):
            knee = (x, 0.46 * tall * slope - 0.01, lift - 0.46 * tall)
            head += [bar(knee, (x * 1.1, y, 0.008), 0.03, 0.014) for y in (-0.12, 0.1)]
        return assembled(head)
    back = 0.03 if kind in ("flat", "portrait") else 0.06
    return assembled([*head, *_stand(rng, width, lift, back)])


def _pair(rng: Rng, head: list[Manifold], width: float, lift: float) -> list[Manifold]:
    """The same screen twice, turned inwards, on the two arms of a rail."""
    turn, shift, solids = rng.uniform(5, 20), width / 2 + 0.01, []
    head = [*head, box((0, -0.051, lift), (0.09, 0.064, 0.03))]
    angle = np.radians(turn)
    out = shift * np.cos(angle) + 0.06 * np.sin(angle)
    ahead = shift * np.sin(angle) - 0.06 * np.cos(angle)
    for side in (-1, 1):
        screen = [part.translate((side * shift, 0, 0)) for part in head]
        solids += [part.rotate((0, 0, side * turn)) for part in screen]
        solids.append(bar((0, -0.07, lift), (side * out, ahead, lift), 0.05, 0.03))
    return solids


def _panel(rng: Rng, kind: str, width: float, tall: float) -> list[Manifold]:
    bezel, chin = rng.uniform(0.008, 0.025), rng.choice([0.0, 0.015])
    thick = rng.uniform(0.02, 0.045)
    if kind == "curved":
        radius, half = width * rng.uniform(1.2, 1.8), 0.5
        turn = np.linspace(-1, 1, 15) * width * half / radius
        arc = np.stack([np.sin(turn), -np.cos(turn)], axis=1)
        rim = np.concatenate([(radius + thick) * arc, radius * arc[::-1]])
        slab = prism(rim, tall).translate((0, radius, -tall / 2))
        bulge = box((0, -thick - 0.01, 0), (width * 0.3, 0.05, tall * 0.5), 0.015)
        return [slab, bulge]
    if kind == "all_in_one":
        chin = tall * 0.16
    body = box((0, -thick / 2, 0), (width, thick, tall), 0.005)
    size = (width - 2 * bezel, 0.024, tall - 2 * bezel - chin)
    solids = [body - box((0, 0, chin / 2), size)]
    if kind in ("bulged", "double") or rng.random() < 0.4:
        wide, deep = rng.uniform(0.5, 0.8), rng.uniform(0.025, 0.06)
        near = box((0, -thick, 0), (width * 0.9, 0.004, tall * 0.9))
        far = box((0, -thick - deep, 0), (width * wide, 0.004, tall * wide))
        solids.append(Manifold.batch_hull([near, far]))
    return solids


def _stand(rng: Rng, width: float, lift: float, back: float) -> list[Manifold]:
    """Neck behind the panel and a foot: plate, disc, vee, arch or sheet."""
    y, reach = -back, width * rng.uniform(0.22, 0.32)
    neck, upper = rng.uniform(0.035, 0.1), np.array((0, y, lift))
    hub = box((0, (y - 0.028) / 2, lift), (neck, -y - 0.008, 0.03))
    kind = str(rng.choice(["plate", "disc", "vee", "arch", "sheet", "arm"]))
    if kind == "arm":
        elbow = np.array(
            (rng.uniform(-0.2, 0.2), y - 0.18, lift + rng.uniform(-0.1, 0.05))
        )
        foot = np.array((0, y - 0.32, elbow[2]))
        solids = [hub, rod(upper, elbow, 0.022), rod(elbow, foot, 0.024)]
        solids += [rod(p - (0, 0, 0.04), p + (0, 0, 0.04), 0.03) for p in (elbow, foot)]
        solids.append(rod((0, foot[1], 0), foot, 0.02))
        return [*solids, box((0, foot[1], 0.01), (0.12, 0.12, 0.02))]
    if kind == "arch":
        path = [(-reach, 0.1, 0.012), (-reach, -0.12, 0.012), (0, y - 0.01, lift)]
        path += [(reach, -0.12, 0.012), (reach, 0.1, 0.012)]
        return [hub, *tube_along(np.array(path), 0.011, 8)]
    if kind == "sheet":
        thin = 0.012
        side = [(0.12, 0.0), (0.12, thin), (-0.1, thin), (y, lift), (y - thin, lift)]
        side += [(-0.1 - 1.5 * thin, 0.0)]
        return [hub, side_profile(np.array(side), reach * 1.3)]
    solids = [bar((0, y - 0.01, 0.0), upper - (0, 0.01, 0), neck, 0.03), hub]
    if kind == "plate":
        solids.append(box((0, 0, 0.008), (2 * reach, rng.uniform(0.16, 0.24), 0.016)))
    elif kind == "disc":
        disc = lathe([(0.5, 0), (0.5, 0.012), (0.2, 0.025)], 28)
        solids.append(disc.scale((2 * reach, 0.24, 1)))
    else:
        for side in (-1, 1):
            heel = np.array((0, y - 0.01, 0.012))
            solids.append(bar(heel, (side * reach, 0.13, 0.012), 0.024, 0.04))
    return solids


def _tube_monitor(rng: Rng, width: float) -> list[Manifold]:
    """A cathode-ray tube's box, narrow behind, on a swivel foot."""
    tall, deep = width * rng.uniform(0.8, 0.95), rng.uniform(0.32, 0.44)
    front = box((0, -0.05, 0), (width, 0.1, tall), 0.012)
    screen = box((0, 0.005, 0.01), (width * 0.84, 0.03, tall * 0.76), 0.01)
    shrink = rng.uniform(0.45, 0.7)
    near = box((0, -0.1, 0), (width * 0.94, 0.01, tall * 0.94))
    middle = box((0, -deep * 0.6, 0), (width * 0.86, 0.01, tall * 0.86))
    far = box((0, -deep, -0.02), (width * shrink, 0.01, tall * shrink))
    solids = [front - screen, Manifold.batch_hull([near, middle, far])]
    low = -tall / 2
    if rng.random() < 0.75:
        neck = rod((0, -deep * 0.4, low + 0.03), (0, -deep * 0.4, low - 0.05), 0.09)
        foot = lathe([(0.15, 0), (0.15, 0.012), (0.11, 0.03)])
        solids += [neck, foot.translate((0, -deep * 0.4, low - 0.065))]
    if rng.random() < 0.5:
        for x in np.linspace(-0.3, 0.3, int(rng.integers(3, 7))) * width:
            knob = (x, 0.0, low + 0.06 * tall)
            solids.append(rod(knob, np.add(knob, (0, 0.012, 0)), 0.009, segments=8))
    return assembled(solids)
