"""What the launchers share."""

import subprocess
import sys

import pytest

from experiments import evaluate, make_data, pretrain
from tests.launching import run

PROGRAM = """
import os, sys
from experiments.launch import with_kept_pages
print("started", flush=True)
with_kept_pages()
print(os.environ["GLIBC_TUNABLES"], sys.argv[1:])
"""
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


with_glibc = pytest.mark.skipif(sys.platform != "linux", reason="glibc's settings")


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


def started(monkeypatch, before: str | None) -> tuple[int, dict[str, str]]:
    """How often the program started, and its settings in the end."""
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    if before is not None:
        monkeypatch.setenv("GLIBC_TUNABLES", before)
    command = [sys.executable, "-c", PROGRAM, "--flag=a b"]
    printed = subprocess.run(command, capture_output=True, text=True, check=True)
    *starts, last = printed.stdout.splitlines()
    settings, _, arguments = last.partition(" ")
    assert arguments == "['--flag=a b']"
    return len(starts), dict(pair.split("=") for pair in settings.split(":"))


@with_glibc
def test_once_and_with_the_same_arguments(monkeypatch):
    kept = {f"glibc.malloc.{name}": value for name, value in KEPT.items()}
    assert started(monkeypatch, None) == (2, kept)


@with_glibc
def test_what_the_user_set_stays(monkeypatch):
    given = "glibc.malloc.hugetlb=0:glibc.malloc.check=3"
    starts, settings = started(monkeypatch, given)
    assert starts == 2
    assert settings.pop("glibc.malloc.check") == "3"
    assert settings.pop("glibc.malloc.hugetlb") == "0"
    kept = {f"glibc.malloc.{name}": value for name, value in KEPT.items()}
    kept.pop("glibc.malloc.hugetlb")
    assert settings == kept


@with_glibc
def test_freed_blocks_stay_unless_they_are_large(monkeypatch):
    """Written to and freed: 256 MiB are the program's still, 2 GiB are not."""
    program = """
import numpy as np
from experiments.launch import with_kept_pages
def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096
with_kept_pages()
for size in (2**28, 2**31):
    before = resident()
    block = np.ones(size, np.uint8)
    held = resident()
    del block
    print(held - before > 0.9 * size, resident() - before > 0.9 * size)
"""
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    command = [sys.executable, "-c", program]
    printed = subprocess.run(command, capture_output=True, text=True, check=True)
    assert printed.stdout.split() == ["True", "True", "True", "False"]


@with_glibc
def test_not_where_all_is_set(monkeypatch):
    given = ":".join(f"glibc.malloc.{name}=1" for name in KEPT)
    starts, settings = started(monkeypatch, given)
    assert starts == 1 and set(settings.values()) == {"1"}
