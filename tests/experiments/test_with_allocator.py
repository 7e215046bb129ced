"""experiments/with_allocator.sh: what it sets."""

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
TCMALLOC = "libtcmalloc_minimal.so.4"
OWN = {"TCMALLOC_RELEASE_RATE": "9", "LD_PRELOAD": "libm.so.6"}
CHECK = {"GLIBC_TUNABLES": "glibc.malloc.check=3"}


@pytest.mark.skipif(sys.platform != "linux", reason="settings of Linux")
@pytest.mark.parametrize(
    ("libraries", "given", "expected"),
    [
        ("", {}, [None, None, KEPT]),
        (TCMALLOC, {}, [TCMALLOC, "0", None]),
        ("", CHECK, [None, None, CHECK["GLIBC_TUNABLES"]]),
        (TCMALLOC, OWN, ["libm.so.6", "9", None]),
    ],
)
def test_what_is_not_set_already_is_set(tmp_path, libraries, given, expected):
    """`libraries` are those that are installed."""
    ldconfig = tmp_path / "ldconfig"
    ldconfig.write_text(f"#!/bin/sh\necho '\t{libraries} (libc6) => /lib/x'\n")
    ldconfig.chmod(ldconfig.stat().st_mode | stat.S_IXUSR)
    known = {k: v for k, v in os.environ.items() if k not in ALLOCATOR}
    known["PATH"] = f"{tmp_path}:{known['PATH']}"
    command = [str(SCRIPT), sys.executable, "-c", PRINT, "--flag=a b"]
    ended = subprocess.run(
        command, env=known | given, capture_output=True, text=True, check=True
    )
    assert ended.stdout == f"{expected} ['--flag=a b']\n"
