"""experiments/with_allocator.sh: what it sets, and that memory then stays."""

import os
import pathlib
import stat
import subprocess
import sys

import pytest

from experiments import __file__ as package

SCRIPT = pathlib.Path(package).with_name("with_allocator.sh")
ALLOCATOR = ("LD_PRELOAD", "TCMALLOC_RELEASE_RATE", "GLIBC_TUNABLES")
KEPT = (
    "glibc.malloc.hugetlb=1:glibc.malloc.mmap_threshold=2147483648:"
    "glibc.malloc.trim_threshold=1099511627776:glibc.malloc.arena_max=1"
)
PRINT = f"import os, sys; print([os.environ.get(n) for n in {ALLOCATOR}], sys.argv[1:])"
RESIDENT = """
import numpy as np
def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096
before = resident()
for size in (2**28, 2**31):
    block = np.ones(size, np.uint8)
    held = resident()
    del block
    print(held - before > 0.9 * size, resident() - before > 0.9 * size)
"""

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="settings of Linux")


@pytest.fixture
def run(tmp_path):
    """What Python prints under the script; `libraries` are those that are installed."""

    def run(program: str, libraries: str = "", **environment: str) -> str:
        ldconfig = tmp_path / "ldconfig"
        ldconfig.write_text(f"#!/bin/sh\necho '\t{libraries} (libc6) => /lib/x'\n")
        ldconfig.chmod(ldconfig.stat().st_mode | stat.S_IXUSR)
        known = {k: v for k, v in os.environ.items() if k not in ALLOCATOR}
        known["PATH"] = f"{tmp_path}:{known['PATH']}"
        command = [str(SCRIPT), sys.executable, "-c", program, "--flag=a b"]
        ended = subprocess.run(
            command, env=known | environment, capture_output=True, text=True, check=True
        )
        return ended.stdout

    return run


def test_glibc_keeps_what_is_freed(run):
    assert run(PRINT) == f"[None, None, '{KEPT}'] ['--flag=a b']\n"


def test_tcmalloc_where_it_is(run):
    found = run(PRINT, libraries="libtcmalloc_minimal.so.4")
    assert found == "['libtcmalloc_minimal.so.4', '0', None] ['--flag=a b']\n"


def test_what_is_set_already_stays(run):
    given = "glibc.malloc.check=3"
    assert given in run(PRINT, GLIBC_TUNABLES=given)
    rate = {"TCMALLOC_RELEASE_RATE": "9", "LD_PRELOAD": "libm.so.6"}
    found = run(PRINT, libraries="libtcmalloc_minimal.so.4", **rate)
    assert found.startswith("['libm.so.6', '9', None]")


@pytest.mark.slow
def test_freed_blocks_stay_unless_they_are_large(run):
    """Written to and freed: 256 MiB are the program's still, 2 GiB are not."""
    assert run(RESIDENT).split() == ["True", "True", "True", "False"]
