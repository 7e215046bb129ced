"""Examples in shards: memory-mapped, 16 bits a coordinate, each complete cloud once.

What a training reads over and over. Every cloud is in farthest-point order, so nothing
is sampled again. A shard is a set of files, of V views of C complete clouds:

    shard-00000.complete.npy  uint16 (C, M, 3)  steps of the cloud's box
                .box.npy      float32 (C, 4)    its lowest corner; the size of a step
                .partial.npy  uint16 (V, N, 3)  steps of the same box
                .eye.npy      float32 (V, 3)    the sensor's position; NaN: not known
                .views.npy    int32 (V, 2)      row of the complete cloud; object
                .names.json   [category, name, any_heading] of each view

and, where sensors' maps were kept,

                .map.npy      uint16 (V, H, W)  state and depth of each pixel
                .camera.npy   float32 (V, 18)   whose pixels these are (`View`)

Two bits of a pixel hold the state and fourteen the depth, in steps of equal ratio
between the nearest and the farthest depth of the map: a depth is off by less than a
part in 8,000 where the farthest is fifty times the nearest.

Objects are counted from 0 in each shard, and none is in two.
"""

import json
import pathlib
from typing import Any

import numpy as np
from jaxtyping import Float32, Int, Int32, UInt16

from prism_jax.data.manifest import MANIFEST, check_files, read_manifest
from prism_jax.data.source import Example
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import UNKNOWN, Visibility
from prism_jax.io.errors import InputError, StrPath
from prism_jax.io.files import parsing

DEPTH_BITS = 14
DEPTH_STEPS = 2**DEPTH_BITS - 1

Pixels = UInt16[np.ndarray, "H W"]
View = Float32[np.ndarray, "18"]
"""Rotation row by row, translation, two focal lengths, the principal point, nearest and
farthest depth."""

FORMAT_VERSION = 3
"""Raised with every change of the layout: folders of another one are refused."""
ARRAYS: dict[str, Any] = {
    "complete": UInt16[np.ndarray, "_ _ 3"],
    "box": Float32[np.ndarray, "_ 4"],
    "partial": UInt16[np.ndarray, "_ _ 3"],
    "eye": Float32[np.ndarray, "_ 3"],
    "views": Int32[np.ndarray, "_ 2"],
}
# A folder has them for all of its views or for none.
MAPS: dict[str, Any] = {
    "map": UInt16[np.ndarray, "_ _ _"],
    "camera": Float32[np.ndarray, "_ 18"],
}
NAMES = "names.json"  # written last: a shard is there once its names are
_AGAIN = "delete it and build again"


def shard_file(folder: pathlib.Path, number: int, content: str) -> pathlib.Path:
    """The path of one of a shard's arrays, or of a JSON file, which has its suffix."""
    suffix = content if content.endswith(".json") else f"{content}.npy"
    return folder / f"shard-{number:05d}.{suffix}"


def restored(
    steps: UInt16[np.ndarray, "N 3"], box: Float32[np.ndarray, "4"]
) -> Float32[np.ndarray, "N 3"]:
    """Coordinates of what is stored as steps from the lowest corner of a box."""
    return np.asarray(steps.astype(np.float32) * box[3] + box[:3])


def decode(pixels: Pixels, view: View) -> Visibility:
    """A map of what a sensor knows, in float32."""
    height, width = pixels.shape
    intrinsics = np.eye(3, dtype=np.float32)
    intrinsics[[0, 1], [0, 1]], intrinsics[:2, 2] = view[12:14], view[14:16]
    camera = Camera(view[:9].reshape(3, 3), view[9:12], intrinsics, height, width)
    near, far = view[16:]
    state = (pixels >> DEPTH_BITS).astype(np.uint8)
    ratio = np.log(max(far / near, 1 + 1e-6))
    depth = near * np.exp((pixels & DEPTH_STEPS) * np.float32(ratio / DEPTH_STEPS))
    return Visibility(camera, state, np.where(state == UNKNOWN, 0, depth))


class Shards:
    """A folder of shards as a `Source`: object after object, view after view.

    `remedy` says how such a folder is made, and `expected` what its manifest has to
    say; else InputError. Every file is read once for its sha256; then arrays are mapped
    into memory as they are used.
    """

    def __init__(
        self,
        root: StrPath,
        remedy: str = "write it with experiments.pack",
        **expected: Any,
    ):
        self.root = pathlib.Path(root)
        expected |= {"format_version": FORMAT_VERSION}
        manifest = read_manifest(self.root, remedy, **expected)
        check_files(self.root, manifest["files"], _AGAIN)
        with parsing(self.root / MANIFEST, "a manifest of shards", _AGAIN, Exception):
            self.categories = tuple(map(str, manifest["categories"]))
        self._mapped: dict[tuple[int, str], Any] = {}
        self._has_maps = any(name.endswith(".map.npy") for name in manifest["files"])
        count = sum(name.endswith(NAMES) for name in manifest["files"])
        if count == 0:
            raise InputError(self.root, "no shards", _AGAIN)
        objects = [self._array(number, "views")[:, 1] for number in range(count)]
        self._starts = np.cumsum([0, *map(len, objects)])
        firsts = np.cumsum([0, *(rows.max() + 1 for rows in objects)])
        rows = [own + first for own, first in zip(objects, firsts, strict=False)]
        self.objects: Int[np.ndarray, " N"] = np.concatenate(rows)

    def __len__(self) -> int:
        return len(self.objects)

    def __getitem__(self, index: int) -> Example:
        index = range(len(self))[index]
        shard = int(np.searchsorted(self._starts, index, "right")) - 1
        view = index - self._starts[shard]
        cloud = self._array(shard, "views")[view, 0]
        box, eye = self._array(shard, "box")[cloud], self._array(shard, "eye")[view]
        category, name, any_heading = self._array(shard, NAMES)[view]
        visibility = None
        if self._has_maps:
            arrays = (np.array(self._array(shard, n)[view]) for n in MAPS)
            visibility = decode(*arrays)
        return Example(
            restored(self._array(shard, "complete")[cloud], box),
            restored(self._array(shard, "partial")[view], box),
            np.array(eye) if np.isfinite(eye).all() else None,
            category,
            name,
            ordered=True,
            any_heading=any_heading,
            visibility=visibility,
        )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_mapped": {}}

    def _array(self, shard: int, name: str) -> Any:
        """One of a shard's arrays, or what its JSON file holds, once it is checked."""
        key = shard, name
        if key not in self._mapped:
            path = shard_file(self.root, shard, name)
            # NumPy evaluates an array's header, and raises what that leads to.
            with parsing(path, "a valid shard", _AGAIN, Exception):
                if path.suffix == ".json":
                    content = json.loads(path.read_text())
                else:
                    content = np.load(path, mmap_mode="r", allow_pickle=False)
                self._check(shard, name, content)
            self._mapped[key] = content
        return self._mapped[key]

    def _check(self, shard: int, name: str, content: Any) -> None:
        """ValueError for another type or length, and for numbers that are no place."""
        if not isinstance(content, (ARRAYS | MAPS).get(name, object)):
            raise ValueError(f"of shape {np.shape(content)}")
        views = content if name == "views" else self._array(shard, "views")
        rows = views[:, 0].max() + 1 if name in ("complete", "box") else len(views)
        if name in (*ARRAYS, *MAPS, NAMES) and not 0 < len(content) == rows:
            raise ValueError(f"{len(content)} rows, not {rows}")
        if name == "views" and not 0 <= content.min() <= content.max() < 10**6:
            raise ValueError("a number is out of range")
        if name in ("box", "camera") and not (np.abs(content) < 1e9).all():
            raise ValueError("not finite")
        if name == "camera" and not (content[:, 16:] > 1e-9).all():
            raise ValueError("a depth is not positive")
        for entry in content if name == NAMES else ():
            if list(map(type, entry)) != [str, str, bool]:
                raise ValueError(f"found {str(entry)[:80]}")
