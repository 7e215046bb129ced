"""Procedural hoppers, one of the kinds of tanks."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.shapes.fittings import nozzle
from experiments.simulation.shapes.valves import hand_wheel
from experiments.simulation.solids import bar, box, corners, lathe, rod, torus

Rng = np.random.Generator


def hopper(rng: Rng) -> list[Manifold]:
    """A round or square bin with a tapered outlet, in a frame of four posts."""
    half, tall = rng.uniform(0.4, 0.6), rng.uniform(0.5, 1.1)
    taper, mouth = rng.uniform(0.6, 1.0) * half * 1.3, rng.uniform(0.06, 0.12)
    free, is_round = taper + rng.uniform(0.25, 0.6), rng.random() < 0.5
    if is_round:
        profile = [(mouth, -taper), (half, 0), (half, tall), (0.96 * half, tall + 0.02)]
        shell = lathe(profile, 36)
        rim = torus(half, 0.025, segments=36, around=6)
        solids = [shell, rim, rim.translate((0, 0, tall))]
    else:
        low = [p + (0, 0, -taper) for p in corners(mouth, mouth)]
        cone = Manifold.hull_points(np.array(low + corners(half, half)))
        solids = [cone, box((0, 0, tall / 2), (2 * half, 2 * half, tall))]
        for level in (0.0, tall - 0.03):
            solids.append(box((0, 0, level), (2.1 * half, 2.1 * half, 0.05)))
    if rng.random() < 0.55:
        inner = 0.93 * half
        if is_round:
            solids.append(
                rod((0, 0, 0.15 * tall), (0, 0, 2 * tall), inner, segments=36)
            )
        else:
            solids.append(box((0, 0, 1.15 * tall), (2 * inner, 2 * inner, 2 * tall)))
        cavity = solids.pop()
        solids = [solid - cavity for solid in solids]
    else:
        up = np.array((0, 0, 1.0))
        for x in (-0.4 * half, 0.4 * half):
            spot = np.array((x, 0.0, tall))
            solids += nozzle(rng, spot, up, rng.uniform(0.05, 0.09), 0.16)
    gate = rng.uniform(1.3, 1.8) * mouth
    solids.append(rod((0, 0, -taper - 0.12), (0, 0, -taper + 0.02), mouth, segments=18))
    solids.append(box((0, 0.1, -taper - 0.05), (2 * gate, 2 * gate + 0.2, 0.035)))
    if rng.random() < 0.5:
        wheel = hand_wheel(rng, 0.1, 0.0)
        point = (0, gate + 0.28, -taper - 0.05)
        end = np.add(point, (0, 0.05, 0))
        solids += [part.rotate((90, 0, 0)).translate(point) for part in wheel]
        solids.append(rod((0, 0.1, point[2]), end, 0.015))
    solids = [solid.translate((0, 0, free)) for solid in solids]
    post, top = rng.uniform(0.06, 0.09), free + rng.uniform(0.05, 0.6) * tall
    reach = half * (1.02 if is_round else 1.0) + post / 2
    for spot in corners(reach, reach):
        solids.append(bar(spot, spot + (0, 0, top), post, post))
        solids.append(box(spot + (0, 0, 0.012), (2 * post, 2 * post, 0.024)))
    for level in (top - post, 0.3 * free) if rng.random() < 0.6 else (top - post,):
        for side in (-reach, reach):
            solids.append(box((0, side, level), (2 * reach, post, post)))
            solids.append(box((side, 0, level), (post, 2 * reach, post)))
    if is_round:
        for angle in (0, 90):
            cleat = bar(
                (-reach, 0, top - post), (reach, 0, top - post), 0.5 * post, post
            )
            solids.append(cleat.rotate((0, 0, angle)))
    return solids
