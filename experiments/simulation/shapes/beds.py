"""Procedural beds."""

import numpy as np

from experiments.simulation.solids import (
    Rng,
    Solids,
    assembled,
    ball,
    bar,
    box,
    corners,
    front_profile,
    on_floor,
    rod,
    side_profile,
)


def bed(rng: Rng) -> Solids:
    """Single to king size on legs, plinth or drawers; head and foot boards of many
    kinds; four-posters, bunk and loft beds. The head is at -y."""
    if rng.random() < 0.17:
        return assembled(_bunk_bed(rng))
    width, length = rng.choice([0.9, 1.2, 1.4, 1.6, 1.8]), rng.uniform(1.9, 2.1)
    deck, thick = rng.uniform(0.22, 0.42), rng.uniform(0.15, 0.28)
    solids = _bed_base(rng, width, length, deck)
    solids += _bedding(rng, width, length, deck - 0.02, thick)
    kinds = ["panel", "arch", "bars", "slats", "padded", "sleigh", "wings"]
    kind = str(rng.choice([*kinds, "none"]))
    tall = deck + thick + rng.uniform(0.25, 0.65)
    solids += _bed_board(rng, kind, -length / 2, width + 0.06, tall)
    if rng.random() < 0.5 and kind != "none":
        low = deck + rng.uniform(0.02, 0.35)
        kind = "panel" if kind in ("padded", "wings") else kind
        solids += _bed_board(rng, kind, length / 2, width + 0.06, low)
    elif rng.random() < 0.25:
        solids += _canopy(rng, width + 0.04, length + 0.04)
    return assembled(solids)


def _bed_base(rng: Rng, width: float, length: float, deck: float) -> Solids:
    wide, long = width + 0.06, length + 0.06
    style = rng.choice(["legs", "plinth", "drawers", "divan"], p=[0.45, 0.2, 0.2, 0.15])
    if style == "legs":
        thick = rng.uniform(0.06, 0.16)
        solids = [box((0, 0, deck - thick / 2), (wide, long, thick), 0.01)]
        leg, taper = rng.uniform(0.05, 0.09), rng.uniform(0.5, 1.0)
        for foot in corners(wide / 2 - 0.6 * leg, long / 2 - 0.6 * leg):
            head = foot + (0, 0, deck - 0.02)
            solids.append(rod(head, foot, 0.6 * leg, 0.6 * leg * taper, 12))
        return solids
    if style == "plinth":
        slab = box((0, 0, deck - 0.06), (wide + 0.1, long + 0.06, 0.12), 0.01)
        low = deck - 0.1
        return [slab, box((0, 0, low / 2), (wide * 0.8, long * 0.85, low))]
    foot = 0.0 if style == "drawers" else 0.06
    solids = [box((0, 0, (deck + foot) / 2), (wide, long, deck - foot), 0.015)]
    if style == "divan":
        seam = box((0, 0, deck / 2), (wide + 1, 0.02, deck + 1))
        solids = [solids[0] - (seam - box((0, 0, 0), (wide - 0.03, 1, 9)))]
        feet = corners(wide / 2 - 0.1, long / 2 - 0.1)
        return solids + [rod(p, p + (0, 0, foot + 0.02), 0.03) for p in feet]
    count, tall = int(rng.integers(1, 4)), deck * 0.62
    pitch = long / count
    for side in (-1, 1):
        for index in range(count):
            center = (side * wide / 2, (index + 0.5) * pitch - long / 2, deck * 0.45)
            solids.append(box(center, (0.04, pitch * 0.88, tall)))
            knob = np.add(center, (side * 0.035, 0, tall * 0.25))
            solids.append(box(knob, (0.04, 0.12, 0.025)))
    return solids


def _bedding(rng: Rng, width: float, length: float, low: float, thick: float) -> Solids:
    """Mattress, pillows at -y, and a blanket or a folded one in some."""
    top = low + thick
    solids = [box((0, 0, low + thick / 2), (width, length, thick), 0.04)]
    count = 1 if width < 1.3 else 2
    wide, lean = min(width / count * 0.86, 0.75), rng.uniform(0, 45)
    for row in range(int(rng.integers(1, 3))):
        for index in range(count):
            x = (index + 0.5 - count / 2) * width / count
            pillow = box((0, 0.2, 0.06), (wide * (1 - 0.15 * row), 0.4, 0.15), 0.055)
            y = -length / 2 + 0.08 + 0.22 * row
            (pillow,) = on_floor([pillow.rotate((lean, 0, 0))])
            solids.append(pillow.translate((x, y, top - 0.025)))
    style, over = (
        rng.choice(["none", "throw", "cover", "cover"]),
        rng.uniform(0.02, 0.1),
    )
    if style == "throw":
        band, y = rng.uniform(0.3, 0.6), length * rng.uniform(0.15, 0.3)
        solids.append(box((0, y, top - 0.1), (width + 0.05, band, 0.25), 0.02))
    elif style == "cover":
        share, deep = rng.uniform(0.55, 0.75), rng.uniform(0.5, 0.95) * thick
        y, z = length / 2 - share * length / 2 + 0.02, top + 0.03 - deep / 2
        solids.append(box((0, y, z), (width + over, share * length, deep), 0.03))
        fold = (0, y - share * length / 2 + 0.1, z + 0.02)
        solids.append(box(fold, (width + over + 0.02, 0.22, deep), 0.03))
    return solids


def _bed_board(rng: Rng, kind: str, y: float, width: float, tall: float) -> Solids:
    out, thick = float(np.sign(y)), rng.uniform(0.04, 0.08)
    y += out * 0.03
    if kind == "none":
        return []
    if kind == "sleigh":
        level = np.linspace(0, 1, 9)
        bend = out * 0.22 * level**3
        rim = np.stack([y + bend, 0.05 + (tall - 0.05) * level], axis=1)
        outline = np.concatenate([rim + (thick / 2, 0), rim[::-1] - (thick / 2, 0)])
        roll = rod((-width / 2, *rim[-1]), (width / 2, *rim[-1]), thick, segments=14)
        return [side_profile(outline, width), roll]
    if kind == "arch":
        turn, flat = np.linspace(0, np.pi, 17), rng.uniform(0.3, 0.9) * tall
        arc = [width / 2 * np.cos(turn), flat + (tall - flat) * np.sin(turn)]
        outline = np.concatenate(
            [[(-width / 2, 0.0), (width / 2, 0.0)], np.stack(arc, axis=1)]
        )
        return [front_profile(outline, thick).translate((0, y, 0))]
    if kind in ("bars", "slats"):
        return _open_board(rng, kind, y, width, tall, thick)
    solids = [box((0, y, tall / 2), (width, thick, tall), 0.015)]
    if kind == "wings":
        wing = (0.05, rng.uniform(0.15, 0.4), tall)
        for x in (-width / 2, width / 2):
            solids.append(box((x, y - out * wing[1] / 2, tall / 2), wing, 0.015))
    if kind == "padded":
        columns, rows = int(rng.integers(2, 7)), int(rng.integers(1, 4))
        cell = width / columns, tall * 0.55 / rows
        for index in np.ndindex(columns, rows):
            x = (index[0] + 0.5) * cell[0] - width / 2
            z = tall - (index[1] + 0.5) * cell[1]
            solids.append(
                box((x, y - out * 0.04, z), (1.02 * cell[0], 0.1, 1.02 * cell[1]), 0.03)
            )
    return solids


def _open_board(
    rng: Rng, kind: str, y: float, width: float, tall: float, thick: float
) -> Solids:
    """Posts and a top rail, filled with upright bars or with slats across."""
    edge, low, solids = width / 2 - thick / 2, min(0.25, tall * 0.6), []
    for x in (-edge, edge):
        solids.append(rod((x, y, 0), (x, y, tall), thick / 2, segments=14))
        solids.append(ball((x, y, tall), thick * rng.uniform(0.5, 0.9), 12))
    heights = [low, tall - 0.03]
    if kind == "slats":
        heights = list(np.linspace(low, tall - 0.06, int(rng.integers(3, 6))))
    for z in heights:
        deep = 0.03 if kind == "bars" else 0.09
        solids.append(box((0, y, z), (2 * edge, thick * 0.6, deep)))
    if kind == "bars":
        for x in np.linspace(-edge, edge, int(rng.integers(5, 12)))[1:-1]:
            solids.append(rod((x, y, low), (x, y, tall - 0.03), 0.012, segments=8))
    return solids


def _canopy(rng: Rng, width: float, length: float) -> Solids:
    tall, post = rng.uniform(1.8, 2.2), rng.uniform(0.05, 0.09)
    x, y, z = width / 2, length / 2, tall - post / 2
    feet = corners(x, y)
    solids = [box(foot + (0, 0, tall / 2), (post, post, tall)) for foot in feet]
    for side in (-1, 1):
        solids.append(box((0, side * y, z), (width, post * 0.8, post)))
        solids.append(box((side * x, 0, z), (post * 0.8, length, post)))
    if rng.random() < 0.5:
        solids.append(box((0, 0, tall - 0.01), (width, length, 0.03)))
    return solids


def _bunk_bed(rng: Rng) -> Solids:
    """Two decks, or one above a desk; a ladder at the side or at the foot."""
    width, length = rng.uniform(0.8, 1.2), rng.uniform(1.9, 2.05)
    upper, post = rng.uniform(1.2, 1.5), rng.uniform(0.05, 0.09)
    tall, x, y = upper + rng.uniform(0.35, 0.5), width / 2, length / 2
    feet, solids = corners(x, y), []
    solids += [box(foot + (0, 0, tall / 2), (post, post, tall)) for foot in feet]
    is_loft = rng.random() < 0.35
    for deck in [upper] if is_loft else [rng.uniform(0.25, 0.4), upper]:
        solids.append(box((0, 0, deck - 0.06), (width, length, 0.12)))
        solids += _bedding(rng, width - 0.06, length - 0.06, deck - 0.02, 0.16)
    if is_loft:
        solids.append(box((-x * 0.4, 0, 0.73), (width * 0.6, length, 0.04)))
        solids.append(box((-x * 0.4, -y * 0.6, 0.36), (width * 0.5, 0.4, 0.73)))
    for z in np.linspace(upper + 0.22, tall - 0.04, int(rng.integers(1, 3))):
        for side in (-1, 1):
            solids.append(box((0, side * y, z), (width, 0.03, 0.07)))
            solids.append(box((side * x, 0, z), (0.03, length, 0.07)))
    at_side = rng.random() < 0.6
    middle = np.array((x + 0.06, y * 0.6, 0) if at_side else (0, y + 0.06, 0))
    along = np.array((0, 0.2, 0) if at_side else (0.2, 0, 0))
    out = np.array((0.25, 0, 0) if at_side else (0, 0.25, 0))
    out, head = out * rng.choice([0.0, 1.0]), middle + (0, 0, upper + 0.25)
    for side in (-1, 1):
        start, end = middle + side * along + out, head + side * along
        solids.append(bar(start, end, 0.045, 0.045))
    for share in np.linspace(0.12, 0.8, 5):
        rung = (1 - share) * (middle + out) + share * head
        solids.append(rod(rung - along, rung + along, 0.018, segments=8))
    step = (0.16, 0.5, 0.08) if at_side else (0.5, 0.16, 0.08)
    return solids + [box(middle + (0, 0, upper - 0.05), step)]
