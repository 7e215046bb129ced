"""Builds splits of scenes."""

import dataclasses
import functools
import json
import os
import pathlib
from collections.abc import Iterator
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from experiments.simulation.building import build
from experiments.simulation.configs import SetConfig, shards_of
from experiments.simulation.objects.catalogues import FOLDER
from experiments.simulation.raycast import Scene, sample_outside
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.scenes.arrangement import (
    DEFAULT_SOURCES,
    Part,
    Pools,
    Thing,
    arranged,
    check_sources,
    pools_of,
    random_room,
    turned,
)
from experiments.simulation.scenes.sensing import (
    Measured,
    PlacedSensor,
    measured,
    random_camera,
    random_lidar,
)
from experiments.simulation.shapes import category_rng
from experiments.simulation.shard_writer import (
    box_of,
    is_written,
    quantised,
    write_array,
    write_shard,
)
from experiments.simulation.views import PARTIAL_POINTS, SURFACE_POINTS
from prism_jax.data.datasets import (
    OBJECTS_VERSION,
    OPEN_VERSION,
    SCENES_VERSION,
    SHAPES_VERSION,
    folder_of,
)
from prism_jax.data.ordering import farthest_point_order
from prism_jax.data.scenes import TRAITS, LabelledScene
from prism_jax.data.shards import FORMAT_VERSION, shard_file
from prism_jax.data.source import Example
from prism_jax.io.atomic import make_output_dir, write_bytes

NUM_THINGS = (2, 8)
MIN_RETURNS = 64  # a thing of fewer is taken away
MAX_DRAWS = 100
TABLE_SHARE, LIDAR_SHARE = 0.55, 0.35
"""Of all scenes those on tables, and of those on floors those that a lidar sees; its
noise is as large as what stands on tables."""

VERSIONS = {"shapes": SHAPES_VERSION, "open": OPEN_VERSION, "objects": OBJECTS_VERSION}


@dataclasses.dataclass(frozen=True)
class ScenesConfig(SetConfig):
    """What a split of the scenes is made of."""

    SIZES: ClassVar = {
        "train": {"num_scenes": 2_000},
        "validation": {"num_scenes": 120},
        "test": {"num_scenes": 120},
    }

    num_scenes: int = 0
    sources: tuple[str, ...] = DEFAULT_SOURCES  # of `things.SOURCES`
    seed: int = 0  # of the whole set
    shard_scenes: int = 20

    def __post_init__(self):
        super().__post_init__()
        check_sources(self.sources, self.split)


class MadeScene(NamedTuple):
    """A scene before it is stored."""

    things: tuple[Thing, ...]  # with their meshes in their places
    parts: tuple[Part, ...]  # what is around them
    sensor: PlacedSensor
    measured: Measured
    complete: Float64[np.ndarray, "K 16384 3"]  # of each thing, farthest points first
    traits: tuple[str, ...]  # as in `LabelledScene`


def build_scenes(
    config: ScenesConfig,
    data_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
    catalogue_dir: str | os.PathLike = FOLDER,
) -> pathlib.Path:
    """Builds what is missing of a split and returns its folder.

    A catalogue of models that is asked for and not there raises InputError.
    """
    folder = make_output_dir(folder_of("scenes", config.split, data_dir))
    pools = pools_of(config.split, config.sources, catalogue_dir, progress)
    content = config.content(
        "scenes",
        SCENES_VERSION,
        source_versions={name: VERSIONS[name] for name in config.sources},
        models=pools.digests,
        categories=pools.categories,
        partial_points=PARTIAL_POINTS,
        complete_points=SURFACE_POINTS,
    )
    shards = shards_of(config.num_scenes, config.shard_scenes)
    return build(
        folder,
        {"format_version": FORMAT_VERSION, **content},
        [len(shard) for shard in shards],
        lambda number: is_written(folder, number),
        functools.partial(_build_shard, folder, config, pools, shards),
        "scene",
        num_workers,
        progress,
    )


def make_scene(config: ScenesConfig, pools: Pools, index: int) -> MadeScene:
    """A pure function of the seed, the split, the sources and the index. Things of
    fewer returns than `MIN_RETURNS` are taken away; with fewer than two it is drawn
    anew."""
    split = list(config.SIZES).index(config.split)
    rng = category_rng("scenes", config.seed, split, index)
    for _ in range(MAX_DRAWS):
        made = _drawn(pools, rng)
        if made is not None:
            return made
    raise ValueError(f"no scene of two things in {MAX_DRAWS} draws")


def _drawn(pools: Pools, rng: np.random.Generator) -> MadeScene | None:
    support = "table" if rng.random() < TABLE_SHARE else "floor"
    has_lidar = support == "floor" and rng.random() < LIDAR_SHARE
    count = rng.integers(NUM_THINGS[0], NUM_THINGS[1] + 1)
    things = [pools.draw(rng) for _ in range(count)]
    meshes = arranged([thing.mesh for thing in things], support, rng)
    room, heading = random_room(meshes, support, rng), rng.uniform(0, 360)
    turn = Rotation.from_euler("z", heading, degrees=True).as_matrix()
    things = [
        thing._replace(mesh=turned(mesh, turn))
        for thing, mesh in zip(things, meshes, strict=True)
    ]
    parts = tuple(part._replace(mesh=turned(part.mesh, turn)) for part in room.parts)
    whole = Scene(together([thing.mesh for thing in things]))
    make_sensor = random_lidar if has_lidar else random_camera
    sensor = make_sensor(whole, room.has_wall, heading, rng)
    while True:
        found = measured(*_world(things, parts), sensor, rng)
        kept = np.bincount(found.labels[found.labels >= 0], minlength=len(things))
        kept = kept >= MIN_RETURNS
        if kept.sum() < NUM_THINGS[0]:
            return None
        if kept.all():
            break
        things = [thing for thing, is_kept in zip(things, kept, strict=True) if is_kept]
    complete = [_complete(thing, rng) for thing in things]
    wall = ("wall",) if room.has_wall else ()
    return MadeScene(
        tuple(things),
        parts,
        sensor,
        found,
        np.stack(complete),
        (sensor.name, support, *wall),
    )


def _world(things: list[Thing], parts: tuple[Part, ...]) -> tuple[Scene, np.ndarray]:
    """All meshes as one, and the label of each of its faces."""
    meshes = [thing.mesh for thing in things] + [part.mesh for part in parts]
    labels = [*range(len(things)), *(part.label for part in parts)]
    return Scene(together(meshes)), np.repeat(labels, [len(m.faces) for m in meshes])


def _complete(thing: Thing, rng: np.random.Generator) -> np.ndarray:
    surface = sample_outside(Scene(thing.mesh), SURFACE_POINTS, rng, thing.two_sided)
    return farthest_point_order(surface, SURFACE_POINTS)


def labelled(made: MadeScene, name: str) -> LabelledScene:
    """A scene as it is read back, but for the rounding."""
    return LabelledScene(
        made.measured.points.astype(np.float32),
        made.measured.labels,
        made.complete.astype(np.float32),
        tuple(thing.category for thing in made.things),
        made.sensor.rays.eye,
        made.sensor.rotation,
        name,
        made.traits,
    )


def examples(scene: LabelledScene) -> Iterator[Example]:
    """The things of a scene one by one."""
    for number, complete in enumerate(scene.complete):
        yield Example(
            complete,
            farthest_point_order(scene.points[scene.labels == number], PARTIAL_POINTS),
            scene.eye.astype(np.float32),
            scene.categories[number],
            f"{scene.name}/{number}",
            ordered=True,
            any_heading=True,
        )


def _build_shard(
    folder: pathlib.Path,
    config: ScenesConfig,
    pools: Pools,
    shards: list[range],
    number: int,
) -> None:
    scenes = [
        labelled(make_scene(config, pools, index), f"{index:06d}")
        for index in shards[number]
    ]
    boxes = [box_of(scene.points) for scene in scenes]
    points = [quantised(s.points, box) for s, box in zip(scenes, boxes, strict=True)]
    columns = {
        "points": np.concatenate(points),
        "labels": np.concatenate([s.labels.astype(np.int8) for s in scenes]),
        "frames": np.stack([_frame(*p) for p in zip(scenes, boxes, strict=True)]),
    }
    for name, column in columns.items():
        write_array(folder, number, name, column)
    traits = json.dumps([[scene.name, scene.traits] for scene in scenes])
    write_bytes(shard_file(folder, number, TRAITS), traits.encode())
    # Last, since the names of its views say that a shard is there.
    write_shard(folder, number, map(examples, scenes))


def _frame(scene: LabelledScene, box: np.ndarray) -> np.ndarray:
    pose = scene.eye, scene.rotation.ravel()
    return np.concatenate([box, *pose, [len(scene.points)]]).astype(np.float64)
