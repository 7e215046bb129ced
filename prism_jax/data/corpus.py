"""The procedural corpus: builds, caches and loads examples of three disjoint splits.

A split is a folder of uncompressed .npz shards and a manifest.json. Its name holds a
digest of whatever the content depends on, so that an interrupted build resumes where
it stopped and another configuration never mixes with it.
"""

import concurrent.futures
import dataclasses
import functools
import hashlib
import io
import json
import multiprocessing
import os
import pathlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int16, Int64
from tqdm import tqdm

from prism_jax.data.examples import (
    PARTIAL_POINTS,
    QUANTUM,
    SURFACE_POINTS,
    make_example,
)
from prism_jax.data.shapes import CATEGORIES
from prism_jax.io.atomic import make_output_dir, write_bytes
from prism_jax.io.errors import InputError
from prism_jax.io.files import default_cache_dir

SPLITS = ("train", "validation", "test")
GENERATOR_VERSION = 1
"""Raised with every change of shapes or partials, so that old caches are left alone."""

_ARRAYS = ("partial", "complete", "viewpoint", "category")


@dataclasses.dataclass(frozen=True)
class CorpusConfig:
    """Sizes and seed of a corpus.

    Example i of a split has category `i % len(CATEGORIES)`: counts are balanced to
    within one, and so is every prefix. Complete clouds keep the first
    `*_complete_points` of the farthest-point order of 16,384 surface points. A size
    that makes no sense raises InputError.
    """

    train_examples: int = 24000
    validation_examples: int = 400
    test_examples: int = 400
    train_complete_points: int = 4096
    evaluation_complete_points: int = SURFACE_POINTS
    seed: int = 0
    shard_examples: int = 200

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            lowest = 0 if field.name == "seed" else 1
            highest = SURFACE_POINTS if field.name.endswith("_points") else 2**31
            if not lowest <= value <= highest:
                fault = f"{value} is not within {lowest} to {highest}"
                raise InputError(field.name, fault, "choose another number")

    def num_examples(self, split: str) -> int:
        """Examples in a split; an unknown split raises InputError."""
        return getattr(self, f"{_checked(split)}_examples")

    def complete_points(self, split: str) -> int:
        """Points of a complete cloud in a split."""
        if _checked(split) == "train":
            return self.train_complete_points
        return self.evaluation_complete_points


class Examples(NamedTuple):
    """Examples as stored: `examples.dequantise` gives coordinates.

    Clouds are in farthest-point order; viewpoints are camera centres in the frame of
    the clouds, and `category` is an index into the names `categories`.
    """

    partial: Int16[np.ndarray, "E 2048 3"]
    complete: Int16[np.ndarray, "E C 3"]
    viewpoint: Float32[np.ndarray, "E 3"]
    category: Int64[np.ndarray, " E"]
    categories: tuple[str, ...]


def shape_seed(config: CorpusConfig, split: str, index: int) -> int:
    """Seed of an example, distinct for every (corpus seed, split, index < 2**32)."""
    block = config.seed * len(SPLITS) + SPLITS.index(_checked(split))
    return (block << 32) + index


def split_dir(
    split: str, config: CorpusConfig, cache_dir: str | os.PathLike | None = None
) -> pathlib.Path:
    """Folder of a split with exactly this content."""
    content = json.dumps(_content(split, config), sort_keys=True)
    digest = hashlib.sha256(content.encode()).hexdigest()[:12]
    root = default_cache_dir() if cache_dir is None else pathlib.Path(cache_dir)
    return root / f"{split}-{digest}"


def build_corpus(
    split: str,
    config: CorpusConfig = CorpusConfig(),
    cache_dir: str | os.PathLike | None = None,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Builds what is missing of a split and returns its folder.

    The bytes do not depend on `num_workers` (by default the number of cores; 0 builds
    in this process). Shards appear whole or not at all; the manifest comes last.
    """
    folder = make_output_dir(split_dir(split, config, cache_dir))
    build = functools.partial(_build_shard, split, config, folder)
    missing = [
        n for n in range(_num_shards(split, config)) if not _shard(folder, n).exists()
    ]
    if not missing and (folder / "manifest.json").exists():
        return folder
    bar = tqdm(total=len(missing), desc=split, unit="shard", disable=not progress)
    with bar:
        if num_workers == 0:
            for number in missing:
                build(number)
                bar.update()
        else:
            _build_parallel(build, missing, num_workers, bar)
    _write_manifest(split, config, folder)
    return folder


def load_corpus(
    split: str,
    config: CorpusConfig = CorpusConfig(),
    cache_dir: str | os.PathLike | None = None,
    limit: int | None = None,
) -> Examples:
    """The first `limit` examples of a split, all by default, from a finished build.

    Every shard is checked against the manifest's sha256. A limit below one, or a
    split that is missing, unfinished or damaged, raises InputError.
    """
    folder = split_dir(split, config, cache_dir)
    manifest = _read_manifest(folder, split)
    if limit is not None and limit < 1:
        raise InputError("limit", f"{limit} is not positive", "ask for one or more")
    count = manifest["examples"] if limit is None else min(limit, manifest["examples"])
    shards = manifest["shards"][: -(-count // config.shard_examples)]
    arrays = [_read_shard(folder / entry["file"], entry["sha256"]) for entry in shards]
    partial, complete, viewpoint, category = (
        np.concatenate([shard[name] for shard in arrays])[:count] for name in _ARRAYS
    )
    categories = tuple(manifest["categories"])
    return Examples(partial, complete, viewpoint, category, categories)


def _checked(split: str) -> str:
    if split not in SPLITS:
        raise InputError("split", f"unknown split {split!r}", f"use one of {SPLITS}")
    return split


def _content(split: str, config: CorpusConfig) -> dict:
    """Everything that the bytes of a split depend on."""
    return {
        "split": split,
        "seed": config.seed,
        "examples": config.num_examples(split),
        "shard_examples": config.shard_examples,
        "partial_points": PARTIAL_POINTS,
        "complete_points": config.complete_points(split),
        "quantum": QUANTUM,
        "categories": list(CATEGORIES),
        "generator_version": GENERATOR_VERSION,
    }


def _num_shards(split: str, config: CorpusConfig) -> int:
    return -(-config.num_examples(split) // config.shard_examples)


def _shard(folder: pathlib.Path, number: int) -> pathlib.Path:
    return folder / f"shard-{number:05d}.npz"


def _build_shard(
    split: str, config: CorpusConfig, folder: pathlib.Path, number: int
) -> None:
    start = number * config.shard_examples
    stop = min(start + config.shard_examples, config.num_examples(split))
    category = np.arange(start, stop) % len(CATEGORIES)
    rows = [
        make_example(
            CATEGORIES[kind],
            shape_seed(config, split, index),
            config.complete_points(split),
        )
        for index, kind in enumerate(category, start)
    ]
    partial, complete, viewpoint = (np.stack(c) for c in zip(*rows, strict=True))
    columns = (partial, complete, viewpoint, category.astype(np.int64))
    buffer = io.BytesIO()
    np.savez(buffer, **dict(zip(_ARRAYS, columns, strict=True)))
    write_bytes(_shard(folder, number), buffer.getvalue())


def _build_parallel(build, missing: list[int], num_workers: int | None, bar: tqdm):
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(num_workers, context) as pool:
        futures = [pool.submit(build, number) for number in missing]
        try:
            for future in concurrent.futures.as_completed(futures):
                future.result()
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _write_manifest(split: str, config: CorpusConfig, folder: pathlib.Path) -> None:
    shards = []
    for number in range(_num_shards(split, config)):
        path = _shard(folder, number)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        shards.append({"file": path.name, "sha256": digest})
    manifest = _content(split, config) | {"shards": shards}
    text = json.dumps(manifest, indent=1) + "\n"
    write_bytes(folder / "manifest.json", text.encode())


def _read_manifest(folder: pathlib.Path, split: str) -> dict:
    remedy = f"build it: python -m experiments.make_data --split={split}"
    path = folder / "manifest.json"
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise InputError(path, "this split is not built here", remedy) from None
    except ValueError:
        raise InputError(
            path, "is not valid JSON", f"delete it, then {remedy}"
        ) from None


def _read_shard(path: pathlib.Path, sha256: str) -> dict[str, np.ndarray]:
    remedy = "delete it and build the split again"
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", remedy) from None
    if hashlib.sha256(data).hexdigest() != sha256:
        raise InputError(path, "differs from the manifest's sha256", remedy)
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)
