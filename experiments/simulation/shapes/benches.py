"""Procedural benches."""

import numpy as np
from manifold3d import Manifold

from experiments.simulation.solids import assembled, bar, box, prism, rod, tube_along

Rng = np.random.Generator


def bench(rng: Rng) -> list[Manifold]:
    """A long seat of slats, a plank, a log or cushions; with and without back and
    arms; curved benches too."""
    if rng.random() < 0.12:
        return _curved_bench(rng)
    length, depth = rng.uniform(1.1, 2.2), rng.uniform(0.32, 0.48)
    height = rng.uniform(0.4, 0.48)
    seat = str(rng.choice(["slats", "plank", "cushion", "log"], p=[0.5, 0.2, 0.2, 0.1]))
    thick = 0.12 if seat == "log" else rng.uniform(0.03, 0.07)
    count = 3 if length > 1.8 else 2
    edge = length / 2 - rng.uniform(0.06, 0.3)
    places = np.linspace(-edge, edge, count)
    solids = _bench_seat(rng, seat, length, depth, height, thick)
    under = height - thick + 0.01
    style = str(rng.choice(["panel", "legs", "trestle", "loop", "block", "scroll"]))
    for x in places:
        solids += [
            part.translate((x, 0, 0)) for part in _bench_support(style, depth, under)
        ]
    if style in ("legs", "trestle") and rng.random() < 0.6:
        solids.append(rod((-edge, 0, 0.15), (edge, 0, 0.15), 0.02, segments=10))
    if seat != "log" and rng.random() < 0.6:
        solids += _bench_back(rng, length, depth, height, places)
        if rng.random() < 0.6:
            solids += _bench_arms(rng, depth, height, (places[0], places[-1]))
    return assembled(solids)


def _bench_seat(
    rng: Rng, seat: str, length: float, depth: float, height: float, thick: float
) -> list[Manifold]:
    middle = height - thick / 2
    if seat == "log":
        log = rod((-length / 2, 0, height), (length / 2, 0, height), depth / 2)
        return [log.trim_by_plane((0, 0, -1), -height)]
    if seat == "slats":
        count = int(rng.integers(3, 8))
        pitch = depth / count
        return [
            box(
                (0, (k + 0.5) * pitch - depth / 2, middle), (length, 0.8 * pitch, thick)
            )
            for k in range(count)
        ]
    solids = [box((0, 0, middle), (length, depth, thick), 0.008)]
    if seat == "cushion":
        count, tall = int(rng.integers(1, 5)), rng.uniform(0.05, 0.1)
        pitch = length / count
        for k in range(count):
            center = ((k + 0.5) * pitch - length / 2, 0, height + tall / 2 - 0.01)
            solids.append(box(center, (0.985 * pitch, depth, tall), 0.02))
    return solids


def _bench_support(style: str, depth: float, top: float) -> list[Manifold]:
    """One support, in the plane x = 0, with a beam under the seat."""
    y, beam = depth / 2 - 0.04, box((0, 0, top), (0.05, depth, 0.05))
    if style == "panel":
        return [box((0, 0, top / 2), (0.05, depth * 0.92, top))]
    if style == "block":
        return [box((0, 0, top / 2), (0.3, depth * 0.85, top), 0.02)]
    if style == "legs":
        legs = [bar((0, s * y, top), (0, s * y, 0), 0.05, 0.05) for s in (-1, 1)]
        return [beam, box((0, 0, 0.15), (0.04, 2 * y, 0.04)), *legs]
    if style == "trestle":
        legs = [
            bar((0, -0.6 * s * y, top), (0, 1.1 * s * y, 0), 0.05, 0.06)
            for s in (-1, 1)
        ]
        return [beam, box((0, 0, 0.15), (0.04, 1.2 * y, 0.05)), *legs]
    if style == "loop":
        path = [(0, -y, top), (0, -y, 0.02), (0, y, 0.02), (0, y, top)]
        return [beam, *tube_along(np.array(path), 0.022, 8)]
    turn = np.linspace(-0.1, np.pi + 0.1, 9)
    arch = np.stack([0 * turn, 1.1 * y * np.cos(turn), top * 0.75 * np.sin(turn)], 1)
    column = box((0, 0, top * 0.85), (0.05, 0.08, top * 0.3))
    return [beam, column, *tube_along(arch, 0.026, 8)]


def _bench_back(
    rng: Rng, length: float, depth: float, height: float, places: np.ndarray
) -> list[Manifold]:
    """Posts that lean backwards, with slats along or upright, or a panel."""
    tall, lean = rng.uniform(0.3, 0.5), rng.uniform(0.02, 0.16)
    style = rng.choice(["along", "upright", "panel"], p=[0.45, 0.35, 0.2])

    def at(x: float, level: float) -> np.ndarray:
        return np.array((x, -depth / 2 - lean * level, height - 0.05 + tall * level))

    solids = [bar(at(x, 0.0), at(x, 1.0), 0.05, 0.05) for x in places]
    if style == "along":
        count = int(rng.integers(2, 6))
        half = 0.38 / count
        for level in (np.arange(count) + 0.7) / (count + 0.2):
            slat = bar(at(0.0, level - half), at(0.0, level + half), length, 0.03)
            solids.append(slat.translate((0, 0.035, 0)))
        return solids
    if style == "panel":
        panel = bar(at(0.0, 0.25), at(0.0, 1.0), length, 0.04)
        return [*solids, panel.translate((0, 0.03, 0))]
    wide = places[-1] - places[0] + 0.05
    for low, high in ((0.2, 0.3), (0.88, 1.05)):
        solids.append(bar(at(0.0, low), at(0.0, high), wide, 0.045))
    count = int(wide / rng.uniform(0.08, 0.16))
    for x in np.linspace(places[0], places[-1], count)[1:-1]:
        solids.append(bar(at(x, 0.25), at(x, 0.95), 0.035, 0.025))
    return solids


def _bench_arms(
    rng: Rng, depth: float, height: float, places: tuple[float, float]
) -> list[Manifold]:
    rise, solids = rng.uniform(0.17, 0.26), []
    front, back = depth / 2 - 0.03, -depth / 2 - 0.03
    is_round = rng.random() < 0.4
    for x in places:
        head, foot = (x, front, height + rise), (x, front, height - 0.06)
        if is_round:
            turn = np.linspace(0, np.pi, 9)
            y = back + (front - back) * (1 + np.cos(turn)) / 2
            path = np.stack([0 * y + x, y, height + rise * np.sin(turn) ** 0.6], 1)
            solids += tube_along(path, 0.022, 8)
            solids.append(rod(foot, (x, front, height + 0.02), 0.022, segments=8))
            continue
        solids.append(bar(foot, head, 0.045, 0.045))
        center = (x, (front + back) / 2, height + rise)
        solids.append(box(center, (0.07, front - back + 0.06, 0.04), 0.01))
    return solids


def _curved_bench(rng: Rng) -> list[Manifold]:
    """An arc about the sitter's front, backless or with a low wall behind."""
    inner, depth = rng.uniform(0.7, 1.3), rng.uniform(0.35, 0.5)
    half, height = rng.uniform(0.5, 1.3), rng.uniform(0.4, 0.48)
    turn = np.linspace(-half, half, 13) - np.pi / 2

    def sector(near: float, far: float, low: float, high: float) -> Manifold:
        arc = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        outline = np.concatenate([far * arc, near * arc[::-1]])
        return prism(outline, high - low).translate((0, inner, low))

    outer = inner + depth
    solids = [sector(inner, outer, height - 0.06, height)]
    if rng.random() < 0.4:
        solids.append(sector(inner + 0.06, outer - 0.04, 0.0, height - 0.05))
    else:
        for angle in np.linspace(-0.85 * half, 0.85 * half, int(rng.integers(2, 5))):
            center = (0, -inner - depth / 2, height / 2 - 0.02)
            block = box(center, (0.16, depth * 0.8, height - 0.04))
            block = block.rotate((0, 0, float(np.degrees(angle))))
            solids.append(block.translate((0, inner, 0)))
    if rng.random() < 0.5:
        solids.append(sector(outer - 0.06, outer, height - 0.03, height + 0.35))
    return solids
