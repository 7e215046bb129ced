"""What the launchers share: a quiet log, and faults of the input in one line."""

import ctypes.util
import os
import pathlib
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

import jax
from absl import app, logging

from prism_jax.io.atomic import make_output_dir
from prism_jax.io.errors import InputError
from prism_jax.io.files import default_cache_dir


def launch(name: str, main: Callable[[], None]) -> None:
    """Runs ``main`` under absl; an `InputError` ends in one line and exit status 2."""

    def without_arguments(argv: Sequence[str]) -> None:
        if len(argv) > 1:
            raise InputError(argv[1], "is no flag", "write --name=value for each")
        main()

    keep_compiled()
    logging.set_verbosity(logging.WARNING)
    try:
        app.run(without_arguments)
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(2)


def prepare_output(path: str | None, suffix: str) -> None:
    """Raises InputError now for an output that could not be written at the end, or
    whose name does not end as it must for what is written beside it."""
    if path is None:
        return
    if pathlib.Path(path).suffix != suffix:
        remedy = f"name a file that ends in {suffix}"
        raise InputError("--output", f"{path} is no {suffix} file", remedy)
    make_output_dir(pathlib.Path(path).parent)


def keep_compiled() -> None:
    """Has JAX keep what it compiles in the cache folder, for the next run.

    $JAX_COMPILATION_CACHE_DIR says where else; set to nothing, that nothing is kept.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = str(default_cache_dir() / "jax")
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


_TCMALLOC = {
    "TCMALLOC_RELEASE_RATE": "0",
    "TCMALLOC_LARGE_ALLOC_REPORT_THRESHOLD": str(2**60),
}
"""Nothing goes back, and large blocks are no news."""

_GLIBC = {
    "hugetlb": 1,
    "mmap_threshold": 2**31,
    "trim_threshold": 2**40,
    "arena_max": 1,
}
"""Large pages, and one heap that gives nothing back but blocks of 2 GiB and more, which
would leave holes as large."""


def with_kept_pages() -> None:
    """Starts this program anew with memory that its allocator keeps.

    XLA's CPU backend allocates a step's temporaries anew each time: without this a
    seventh of a training's time is the kernel's, clearing pages. tcmalloc keeps them
    where it is installed; else glibc does, in large pages, but its search for room
    takes an eighth of a training. Either is chosen when a program starts and never
    again. What $LD_PRELOAD and the allocators' own variables hold stays. Does nothing
    where all is set, or without Linux.
    """
    if sys.platform != "linux" or os.environ.get("LD_PRELOAD"):
        return
    library = ctypes.util.find_library("tcmalloc_minimal")
    if library is not None:
        _start_anew(_TCMALLOC | os.environ | {"LD_PRELOAD": library})
    before = os.environ.get("GLIBC_TUNABLES", "")
    settings = {f"glibc.malloc.{name}": value for name, value in _GLIBC.items()}
    missing = [f"{name}={settings[name]}" for name in settings if name not in before]
    if missing:
        tunables = ":".join([before, *missing] if before else missing)
        _start_anew(os.environ | {"GLIBC_TUNABLES": tunables})


def _start_anew(environment: dict[str, str]) -> NoReturn:
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)
