"""What stands in scenes, by split, and where, so that nothing is in another."""

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Float64
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from experiments.simulation.objects.catalogues import FOLDER, Model, category_of
from experiments.simulation.objects.survey import survey
from experiments.simulation.open_shapes import CATEGORY, make_open_shape
from experiments.simulation.open_shapes.build import OpenConfig
from experiments.simulation.roboarm.furnishings import table, to_mesh
from experiments.simulation.shapes import make_shape
from experiments.simulation.shapes.build import ShapesConfig, shape_seed
from experiments.simulation.solids import Rng, box
from prism_jax.io.errors import InputError, choose
from prism_jax.preprocessing.segmentation.scene import LEFT_OVER, SUPPORT

SOURCES: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "shapes": {
        "train": ("train",),
        "validation": ("validation", "novel"),
        "test": ("test", "unseen"),
    },
    "open": {"train": ("train",)},
    "objects": {"train": ("train",), "validation": ("validation",), "test": ("test",)},
}
"""Splits of each source, by the split of the scenes that they stand in."""

DEFAULT_SOURCES = ("shapes", "open")  # the procedural ones


class Thing(NamedTuple):
    """A mesh, z up, and what it is; `two_sided` as in `raycast.sample_outside`."""

    mesh: trimesh.Trimesh
    category: str
    two_sided: bool = False


Pool = Callable[[np.random.Generator], Thing]
"""Draws a thing. Can be pickled."""


class Pools(NamedTuple):
    """What the things of a split's scenes are drawn from, each as often as others."""

    pools: tuple[Pool, ...]  # one for each split of each source
    categories: tuple[str, ...]
    digests: dict[str, str]  # of the meshes of models that people made, by identity

    def draw(self, rng: np.random.Generator) -> Thing:
        """A thing of any of them."""
        return self.pools[rng.integers(len(self.pools))](rng)


def check_sources(sources: Sequence[str], split: str) -> None:
    """Raises InputError for a source that there is not, or where none has the split."""
    for source in sources:
        choose("sources", source, SOURCES)
    if not any(split in SOURCES[source] for source in sources):
        fault = f"{', '.join(sources) or 'none'} cannot be used in scenes of {split}"
        raise InputError("sources", fault, "add shapes or objects")


def pools_of(
    split: str,
    sources: Sequence[str] = DEFAULT_SOURCES,
    catalogue_dir: str | os.PathLike = FOLDER,
    progress: bool = True,
) -> Pools:
    """What can stand in scenes of a split: the very shapes and models that the sets of
    that name and split have, with the seed 0."""
    check_sources(sources, split)
    pools: list[Pool] = []
    categories, digests = set(), {}
    if "shapes" in sources:
        for name in SOURCES["shapes"][split]:
            config = ShapesConfig(name)
            pools.append(functools.partial(_shape, config))
            categories |= {*config.categories}
    if "open" in sources and split in SOURCES["open"]:
        pools.append(functools.partial(_open_shape, OpenConfig().num_shapes))
        categories.add(CATEGORY)
    if "objects" in sources:
        found = survey([split], catalogue_dir, progress).models
        digests = {model.identity: digest for model, digest in found}
        models = [model for model, _ in found]
        pools.append(functools.partial(_model, models))
        categories |= {category_of(model.title) for model in models}
    return Pools(tuple(pools), tuple(sorted(categories)), digests)


def _shape(config: ShapesConfig, rng: np.random.Generator) -> Thing:
    index = int(rng.integers(config.num_shapes))
    category = config.categories[index % len(config.categories)]
    return Thing(make_shape(category, shape_seed(config, index)), category)


def _open_shape(count: int, rng: np.random.Generator) -> Thing:
    return Thing(make_open_shape(int(rng.integers(count))), CATEGORY)


def _model(models: Sequence[Model], rng: np.random.Generator) -> Thing:
    model = models[rng.integers(len(models))]  # pyright: ignore
    return Thing(model.load(), category_of(model.title), two_sided=True)


SIZES = {"table": (0.06, 0.4), "floor": (0.25, 1.6)}
"""The longest side of a thing, by what it stands on."""

GAPS = (0.05, 0.8)  # between a thing and its neighbour, in its own size

STEP = 0.02  # in a thing's size, by which it moves away until it has room

MARGINS = (0.05, 0.7)
"""Between things and the border of what they stand on, in half their width."""

TABLE_HEIGHTS, MIN_TABLE = (0.6, 0.9), 0.45
FLOOR_REACH = (0.5, 2.5)  # how far a floor reaches beyond what stands on it

WALL_SHARE, FLOOR_BELOW_SHARE = 0.4, 0.5
WALL_HEIGHTS, WALL_REACH, WALL_GAP = (0.4, 2.0), (0.1, 1.5), (0.0, 0.3)
THICKNESS = 0.1


class Part(NamedTuple):
    """A mesh of what is around the things, and what its points are labelled."""

    mesh: trimesh.Trimesh
    label: int


class Room(NamedTuple):
    """What things stand on, and what is around them."""

    # The table's top, the floor and the wall are `SUPPORT`, the legs `LEFT_OVER`.
    parts: tuple[Part, ...]
    has_wall: bool  # at the side of +y


def arranged(
    meshes: Sequence[trimesh.Trimesh], support: str, rng: Rng
) -> list[trimesh.Trimesh]:
    """The meshes scaled to some of `SIZES` and set down on z = 0, one beside another,
    so that their convex hulls are apart seen from above."""
    placed: list[trimesh.Trimesh] = []
    hulls: list[np.ndarray] = []
    for mesh in meshes:
        low, high = np.log(SIZES[support])
        size = float(np.exp(rng.uniform(low, high)))
        corners = _set_down(mesh, size, rng)
        hull = corners[ConvexHull(corners[:, :2]).vertices, :2]
        if placed:
            angle = rng.uniform(0, 2 * np.pi)
            along = np.array([np.cos(angle), np.sin(angle)])
            start = hulls[rng.integers(len(hulls))].mean(axis=0)
            gap, shift = size * float(np.exp(rng.uniform(*np.log(GAPS)))), start
            while any(separation(hull + shift, other) < gap for other in hulls):
                shift = shift + STEP * size * along
            hull, corners = hull + shift, corners + (*shift, 0.0)
        placed.append(trimesh.Trimesh(corners, mesh.faces, process=False))
        hulls.append(hull)
    return placed


def _set_down(mesh: trimesh.Trimesh, size: float, rng: Rng) -> np.ndarray:
    """Corners of the mesh in that size, turned, its middle above the origin."""
    angle = rng.integers(4) * 90.0 + rng.normal(scale=3.0)
    if rng.random() < 0.5:
        angle = rng.uniform(0, 360)
    corners = Rotation.from_euler("z", angle, degrees=True).apply(mesh.vertices)
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    foot = np.append((lower + upper)[:2] / 2, lower[2])
    return (corners - foot) * (size / np.ptp(mesh.vertices, axis=0).max())


def separation(one: Float[np.ndarray, "N 2"], other: Float[np.ndarray, "M 2"]) -> float:
    """How far two convex polygons are apart across a line along a side of either, which
    is no more than their distance; negative if they overlap."""
    widest = -np.inf
    for first, second in (one, other), (other, one):
        sides = np.roll(first, -1, axis=0) - first
        normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # Corners go round anticlockwise, so that normals point outwards.
        apart = (second @ normals.T).min(axis=0) - (first * normals).sum(axis=1)
        widest = max(widest, float(apart.max()))
    return widest


def random_room(
    things: Sequence[trimesh.Trimesh], support: Literal["table", "floor"], rng: Rng
) -> Room:
    """A table or a floor under things, in some cases with a wall behind them."""
    bounds = np.array([thing.bounds[:, :2] for thing in things])
    lower, upper = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    has_wall = bool(rng.random() < WALL_SHARE)
    margins = rng.uniform(*MARGINS, 4) * (upper - lower).max() / 2
    if support == "floor":
        margins[:3] += rng.uniform(*FLOOR_REACH, 3)
        if not has_wall:
            margins[3] += rng.uniform(*FLOOR_REACH)
    lower, upper = lower - margins[:2], upper + margins[2:]
    parts, ground = [], 0.0
    if support == "table":
        short = np.maximum(MIN_TABLE - (upper - lower), 0)
        lower, upper = lower - short / 2, upper + short / 2
        ground = -rng.uniform(*TABLE_HEIGHTS)
        top, *legs = table(lower, upper, -ground)
        parts += [Part(_moved(to_mesh([top]), ground), SUPPORT)]
        parts += [Part(_moved(to_mesh(legs), ground), LEFT_OVER)]
    behind = upper[1] + (rng.uniform(*WALL_GAP) if support == "table" else 0.0)
    if support == "floor" or rng.random() < FLOOR_BELOW_SHARE:
        reach = np.zeros(2) if support == "floor" else rng.uniform(*FLOOR_REACH, 2)
        last = np.array([upper[0] + reach[0], behind if has_wall else upper[1]])
        parts.append(Part(_slab([*(lower - reach), ground], [*last, ground]), SUPPORT))
    if has_wall:
        sides = rng.uniform(*WALL_REACH, 2)
        first = [lower[0] - sides[0], behind, ground]
        last = [upper[0] + sides[1], behind, rng.uniform(*WALL_HEIGHTS)]
        parts.append(Part(_slab(first, last), SUPPORT))
    return Room(tuple(parts), has_wall)


def _slab(first: Sequence[float], last: Sequence[float]) -> trimesh.Trimesh:
    """Between two corners of a face that looks up, or along -y; as thick as
    `THICKNESS` behind it."""
    lower, upper = np.array(first, float), np.array(last, float)
    if lower[1] == upper[1]:
        upper[1] += THICKNESS
    else:
        lower[2] -= THICKNESS
    return to_mesh([box((lower + upper) / 2, upper - lower)])


def _moved(mesh: trimesh.Trimesh, height: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        mesh.vertices + (0.0, 0.0, height), mesh.faces, process=False
    )


def turned(mesh: trimesh.Trimesh, turn: Float64[np.ndarray, "3 3"]) -> trimesh.Trimesh:
    """The mesh with its corners turned."""
    return trimesh.Trimesh(mesh.vertices @ turn.T, mesh.faces, process=False)
