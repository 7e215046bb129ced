"""What the launchers share."""

import subprocess
import sys
from ctypes.util import find_library

import pytest

from experiments import evaluate, make_data, pretrain
from tests.launching import run

PROGRAM = """
import ctypes.util, os, sys
ctypes.util.find_library = {"tcmalloc_minimal": FOUND}.get
from experiments.launch import with_kept_pages
print("started", flush=True)
with_kept_pages()
print(*(os.environ.get(name, "") for name in ALLOCATOR), sys.argv[1:], sep=";")
"""
ALLOCATOR = (
    "LD_PRELOAD",
    "TCMALLOC_RELEASE_RATE",
    "TCMALLOC_LARGE_ALLOC_REPORT_THRESHOLD",
    "GLIBC_TUNABLES",
)
UNREPORTED = str(2**60)
KEPT = {
    "hugetlb": "1",
    "mmap_threshold": str(2**31),
    "trim_threshold": str(2**40),
    "arena_max": "1",
}


def test_an_output_that_would_overwrite_itself_is_refused(tmp_path, capsys):
    """Markdown goes beside the JSON, under the name with another end."""
    path = tmp_path / "new" / "scores.md"
    assert run(evaluate, f"--output={path}") == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.endswith(
        "scores.md is no .json file; name a file that ends in .json"
    )
    assert not path.parent.exists()


on_linux = pytest.mark.skipif(sys.platform != "linux", reason="settings of Linux")


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (evaluate, ["small-robocell", "--split=test"]),
        (pretrain, ["--workdir=w", "--set", "meta.num_samples=64", "adapt.seed=1"]),
        (make_data, ["shapes"]),
    ],
)
def test_what_is_no_flag_is_refused(capsys, command, arguments):
    """And not dropped, as absl has it after the first of several values."""
    stray = next(word for word in reversed(arguments) if "--" not in word)
    assert run(command, *arguments) == 2
    name = command.__name__.rpartition(".")[2]
    wanted = f"{name}: {stray}: is no flag; write --name=value for each"
    assert capsys.readouterr().err.splitlines()[-1] == wanted


def started(monkeypatch, found: str | None, **before: str) -> tuple[int, list[str]]:
    """How often the program started, and its allocator's variables in the end."""
    for name in ALLOCATOR:
        monkeypatch.delenv(name, raising=False)
    for name, value in before.items():
        monkeypatch.setenv(name, value)
    names = f"FOUND, ALLOCATOR = {found!r}, {ALLOCATOR}\n"
    command = [sys.executable, "-c", names + PROGRAM, "--flag=a b"]
    printed = subprocess.run(command, capture_output=True, text=True, check=True)
    *starts, last = printed.stdout.splitlines()
    *settings, arguments = last.split(";")
    assert arguments == "['--flag=a b']"
    return len(starts), settings


def kept_by_glibc(*names: str) -> str:
    return ":".join(f"glibc.malloc.{name}={KEPT[name]}" for name in names)


@on_linux
def test_once_and_with_the_same_arguments(monkeypatch):
    wanted = ["", "", "", kept_by_glibc(*KEPT)]
    assert started(monkeypatch, None) == (2, wanted)


@on_linux
def test_tcmalloc_where_it_is(monkeypatch):
    wanted = ["libm.so.6", "0", UNREPORTED, ""]
    assert started(monkeypatch, "libm.so.6") == (2, wanted)


@on_linux
def test_what_the_user_set_stays(monkeypatch):
    given = "glibc.malloc.hugetlb=0:glibc.malloc.check=3"
    others = kept_by_glibc(*(name for name in KEPT if name != "hugetlb"))
    wanted = ["", "", "", f"{given}:{others}"]
    assert started(monkeypatch, None, GLIBC_TUNABLES=given) == (2, wanted)
    wanted = ["libm.so.6", "9", UNREPORTED, ""]
    rate = {"TCMALLOC_RELEASE_RATE": "9"}
    assert started(monkeypatch, "libm.so.6", **rate) == (2, wanted)
    wanted = ["libm.so.6", "", "", ""]
    assert started(monkeypatch, "libz.so.1", LD_PRELOAD="libm.so.6") == (1, wanted)


RESIDENT = """
import numpy as np
from experiments.launch import with_kept_pages
def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096
with_kept_pages()
before = resident()
for size in (2**28, 2**31):
    block = np.ones(size, np.uint8)
    held = resident()
    del block
    print(held - before > 0.9 * size, resident() - before > 0.9 * size)
"""


def held_and_kept(monkeypatch, program: str) -> list[str]:
    for name in ALLOCATOR:
        monkeypatch.delenv(name, raising=False)
    command = [sys.executable, "-c", program]
    printed = subprocess.run(command, capture_output=True, text=True, check=True)
    return printed.stdout.split()


@on_linux
def test_freed_blocks_stay_unless_they_are_large(monkeypatch):
    """Written to and freed: 256 MiB are the program's still, 2 GiB are not."""
    without = "import ctypes.util\nctypes.util.find_library = {}.get\n"
    wanted = ["True", "True", "True", "False"]
    assert held_and_kept(monkeypatch, without + RESIDENT) == wanted


@on_linux
@pytest.mark.skipif(
    find_library("tcmalloc_minimal") is None, reason="tcmalloc is a choice"
)
def test_freed_blocks_stay_with_tcmalloc(monkeypatch):
    assert held_and_kept(monkeypatch, RESIDENT) == ["True"] * 4


@on_linux
def test_not_where_all_is_set(monkeypatch):
    given = ":".join(f"glibc.malloc.{name}=1" for name in KEPT)
    wanted = ["", "", "", given]
    assert started(monkeypatch, None, GLIBC_TUNABLES=given) == (1, wanted)
