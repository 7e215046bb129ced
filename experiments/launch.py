"""What the launchers share: a quiet log, and faults of the input in one line."""

import os
import sys
from collections.abc import Callable, Sequence

import jax
from absl import app, logging

from prism_jax.io.errors import InputError
from prism_jax.io.files import default_cache_dir


def launch(name: str, main: Callable[[Sequence[str]], None]) -> None:
    """Runs ``main`` under absl; an `InputError` ends in one line and exit status 2."""
    keep_compiled()
    logging.set_verbosity(logging.WARNING)
    try:
        app.run(main)
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(2)


def keep_compiled() -> None:
    """Has JAX keep what it compiles in the cache folder, for the next run.

    $JAX_COMPILATION_CACHE_DIR says where else; set to nothing, that nothing is kept.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = str(default_cache_dir() / "jax")
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def with_large_pages() -> None:
    """Starts this program anew with glibc's allocations in large pages.

    XLA's CPU backend allocates a step's temporaries anew each time, and in pages of
    4 KiB much of an elementwise operation is page faults. glibc reads the setting when
    a program starts and never again. Does nothing where it is set, or without Linux.
    """
    setting, before = "glibc.malloc.hugetlb", os.environ.get("GLIBC_TUNABLES", "")
    if sys.platform != "linux" or setting in before:
        return
    tunables = f"{before}:{setting}=1" if before else f"{setting}=1"
    command = [sys.executable, *sys.orig_argv[1:]]
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(sys.executable, command, os.environ | {"GLIBC_TUNABLES": tunables})
