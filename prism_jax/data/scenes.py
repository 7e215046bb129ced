"""Scenes of several things, whose every measured point is labelled.

The things of each scene are stored as the views of one object are (`data.shards`): a
partial cloud, the complete one, and where the sensor stood, in the world's frame and in
metres. Beside these each shard has, of S scenes of P points in all,

    shard-00000.points.npy  uint16 (P, 3)   steps of the scene's box, scene after scene
                .labels.npy int8 (P,)       the thing, from 0, `SUPPORT` or `LEFT_OVER`
                .frames.npy float64 (S, 17) the box's lowest corner, the size of a step,
                                            the sensor's position and rotation, and how
                                            many points the scene has
                .traits.json                [name, traits] of each scene
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int

from prism_jax.data.shards import Shards, restored
from prism_jax.data.source import Example
from prism_jax.io.errors import StrPath
from prism_jax.preprocessing.visibility_map import seen_among

TRAITS = "traits.json"


@dataclasses.dataclass(frozen=True)
class LabelledScene:
    """What one sensor measured of several things on a table or a floor."""

    points: Float32[np.ndarray, "N 3"]  # all that was measured
    # For each point the number of its thing, from 0; `SUPPORT` on what things stand on,
    # walls and floors; `LEFT_OVER` for a table's legs and points that fly at an edge.
    labels: Int[np.ndarray, " N"]
    complete: Float32[np.ndarray, "K M 3"]  # of each thing, in farthest-point order
    categories: tuple[str, ...]  # of each thing
    eye: Float64[np.ndarray, "3"]  # where the sensor stood
    # Rows are the sensor's right, down and forward, as `Camera.rotation`.
    rotation: Float64[np.ndarray, "3 3"]
    name: str  # unique within its set
    # What stands for the scene in tables: the sensor, the support, "wall".
    traits: tuple[str, ...] = ()


class Scenes(Shards):
    """A folder of scenes: things one by one as a `Source`, as each was measured among
    the others, or whole by `scene`. All things of a scene count as one object."""

    def __init__(self, root: StrPath, *arguments: Any, **expected: Any):
        super().__init__(root, *arguments, **expected)
        count = len(self._starts) - 1
        frames = [self._array(shard, "frames") for shard in range(count)]
        self._scene_starts = np.cumsum([0, *map(len, frames)])

    def __getitem__(self, index: int) -> Example:
        index = range(len(self))[index]
        example = super().__getitem__(index)
        number = int(self.objects[index])
        scene, first = self.scene(number), np.searchsorted(self.objects, number)
        others = scene.points[scene.labels != index - first]
        assert example.partial is not None
        visibility = seen_among(example.partial, others, scene.eye)
        return example._replace(visibility=visibility)

    @property
    def num_scenes(self) -> int:
        """How many there are."""
        return int(self._scene_starts[-1])

    def scene(self, index: int) -> LabelledScene:
        """A scene by its number; IndexError for one that there is not."""
        index = range(self.num_scenes)[index]
        shard = int(np.searchsorted(self._scene_starts, index, "right")) - 1
        row = int(index - self._scene_starts[shard])
        frames = self._array(shard, "frames")
        starts = np.cumsum([0, *frames[:, 16].astype(int)])
        own = slice(starts[row], starts[row + 1])
        (items,) = np.nonzero(self.objects == index)
        things = [Shards.__getitem__(self, int(item)) for item in items]
        name, traits = self._array(shard, TRAITS)[row]
        box = frames[row, :4].astype(np.float32)
        return LabelledScene(
            points=restored(self._array(shard, "points")[own], box),
            labels=self._array(shard, "labels")[own].astype(int),
            complete=np.array([thing.complete for thing in things]),
            categories=tuple(thing.category for thing in things),
            eye=np.array(frames[row, 4:7]),
            rotation=np.array(frames[row, 7:16]).reshape(3, 3),
            name=name,
            traits=tuple(traits),
        )
