"""Folders that are built in parts, by several processes, and checked."""

import os
import pathlib
import subprocess
import sys
import time

import pytest

from experiments.simulation import building
from prism_jax.data import manifest
from prism_jax.io.errors import InputError

CONTENT = {"generator": "squares", "size": [2, 3]}
SIZES = [2, 2, 1]


class Squares:
    """A build of small files, that can be broken off."""

    def __init__(self, folder, fails_at=None):
        self.folder, self.fails_at, self.built = folder, fails_at, []

    def path(self, number):
        return self.folder / f"{number}.bin"

    def build_item(self, number):
        if number == self.fails_at:
            raise KeyboardInterrupt
        self.built.append(number)
        self.path(number).write_bytes(bytes([number**2]))

    def build(self, content=CONTENT):
        return building.build(
            self.folder,
            content,
            SIZES,
            lambda number: self.path(number).exists(),
            self.build_item,
            "square",
            num_workers=0,
            progress=False,
        )


def test_broken_off_it_leaves_whole_items_and_a_later_run_goes_on(tmp_path):
    whole = Squares(tmp_path / "squares")
    assert whole.build() == whole.folder
    broken = Squares(tmp_path / "broken", fails_at=1)
    with pytest.raises(KeyboardInterrupt):
        broken.build()
    names = {path.name for path in broken.folder.iterdir()}
    assert names == {"manifest.json", "0.bin"}
    with pytest.raises(InputError, match="build was interrupted; build it"):
        manifest.read_manifest(broken.folder, "build it")
    resumed = Squares(tmp_path / "broken")
    resumed.build()
    assert resumed.built == [1, 2]
    for path in whole.folder.iterdir():
        assert (broken.folder / path.name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("fails_at", [None, 2])
def test_other_content_is_refused(tmp_path, fails_at):
    try:
        Squares(tmp_path, fails_at).build()
    except KeyboardInterrupt:
        assert fails_at is not None
    other = {"generator": "squares", "size": [2, 4], "seed": 1}
    with pytest.raises(InputError, match=r"other settings \(seed, size\)"):
        Squares(tmp_path).build(other)


_WAITING = """
import functools, os, pathlib, sys, time
from experiments.simulation import building

def wait(folder, number):
    (folder / f"{os.getpid()}.pid").touch()
    time.sleep(600)

if __name__ == "__main__":
    folder = pathlib.Path(sys.argv[1])
    build = functools.partial(wait, folder)
    building.build(folder, {}, [1], lambda number: False, build, "item", 1)
"""
"""An item that leaves its process's number and never ends."""


@pytest.mark.slow
def test_workers_end_with_a_build_that_is_killed(tmp_path):
    script = tmp_path / "build.py"
    script.write_text(_WAITING)
    folder, root = tmp_path / "items", pathlib.Path(__file__).parents[3]
    parent = subprocess.Popen(
        [sys.executable, script, folder], env={**os.environ, "PYTHONPATH": str(root)}
    )
    try:
        worker = _until(lambda: next(iter(folder.glob("*.pid")), None))
    finally:
        parent.kill()
        parent.wait()
    number = int(worker.stem)
    assert _until(lambda: not pathlib.Path(f"/proc/{number}/fd").exists())


def _until(found, seconds=60):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if result := found():
            return result
        time.sleep(0.1)
    raise TimeoutError
