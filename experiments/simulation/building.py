"""Builds folders of data, by several processes, and goes on where one was broken off.

A folder has a manifest from the start. It says what the content is made from, so that
nothing else is ever mixed in, and in the end every file's sha256.
"""

import concurrent.futures
import json
import multiprocessing
import os
import pathlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from tqdm import tqdm

from prism_jax.data.manifest import MANIFEST, hash_files
from prism_jax.io.atomic import make_output_dir, write_bytes
from prism_jax.io.errors import InputError


def build(
    folder: str | os.PathLike,
    content: Mapping[str, Any],
    sizes: Sequence[int],
    is_built: Callable[[int], bool],
    build_item: Callable[[int], None],
    unit: str,
    num_workers: int | None = None,
    progress: bool = True,
) -> pathlib.Path:
    """Builds what is missing of a folder's items, and then its manifest.

    `content` is everything that the bytes depend on, as JSON. Item i has `sizes[i]`
    units, which a bar counts with `progress`.
    Items are built in `num_workers` processes, by default one for every core, with 0 in
    this one; `build_item` is pickled for them. A folder with other content, or one that
    lost files of an item that `is_built` takes for built, raises InputError.
    """
    folder = make_output_dir(folder)
    wanted: dict[str, Any] = json.loads(json.dumps(content))
    listed = _begun(folder, wanted)
    if listed and all((folder / name).exists() for name in listed):
        return folder
    missing = [number for number in range(len(sizes)) if not is_built(number)]
    total, done = sum(sizes), sum(sizes) - sum(sizes[number] for number in missing)
    with tqdm(
        total=total, initial=done, desc=folder.name, unit=unit, disable=not progress
    ) as bar:
        for number in _run(build_item, missing, num_workers):
            bar.update(sizes[number])
    files = hash_files(folder)
    for name in sorted(set(listed) - set(files)):
        fault = "finished file is missing"
        raise InputError(folder / name, fault, "delete the folder and build again")
    write_manifest(folder, {**wanted, "files": files})
    return folder


def write_manifest(folder: pathlib.Path, content: Mapping[str, Any]) -> None:
    """Writes a folder's manifest, whole or not at all."""
    write_bytes(folder / MANIFEST, (json.dumps(content, indent=1) + "\n").encode())


def _begun(folder: pathlib.Path, content: dict[str, Any]) -> list[str]:
    """The files of a finished build of this content, none of another; begins one in an
    empty folder."""
    path = folder / MANIFEST
    if not path.exists():
        if any(not entry.name.startswith(".") for entry in folder.iterdir()):
            raise InputError(folder, "not empty", "choose a new folder")
        write_manifest(folder, {**content, "files": None})
        return []
    try:
        found = json.loads(path.read_text())
        files = list(found.pop("files") or [])
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(path, "not a valid manifest", "delete the folder") from None
    if found != content:
        changed = [k for k in {*found, *content} if found.get(k) != content.get(k)]
        fault = f"built with other settings ({', '.join(sorted(changed))})"
        remedy = "use those, choose a new folder, or delete this one"
        raise InputError(folder, fault, remedy)
    return files


def _run(
    build_item: Callable[[int], None], items: Sequence[int], num_workers: int | None
) -> Iterator[int]:
    """The items as they are finished."""
    if num_workers == 0:
        for number in items:
            build_item(number)
            yield number
        return
    # Several BLAS threads in each of several processes wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(
        num_workers, context, initializer=_end_with_parent
    ) as pool:
        futures = {pool.submit(build_item, number): number for number in items}
        try:
            for future in concurrent.futures.as_completed(futures):
                future.result()
                yield futures[future]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with_parent() -> None:
    """Has a worker end when the build is killed; it would wait for work for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
