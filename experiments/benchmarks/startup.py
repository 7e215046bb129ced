"""What a newcomer waits for, measured from outside in fresh processes."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

from experiments.benchmarks.measure import Row, row

IMPORT_SECONDS, FIRST_SECONDS, NEXT_SECONDS = 1.5, 45.0, 8.0


def suite() -> Iterator[Row]:
    """Import, the first run with an empty cache, and the runs after it."""
    with tempfile.TemporaryDirectory() as folder:
        bare = ["-c", "import prism_jax"]
        yield _row("import prism_jax", [_seconds(bare, folder) for _ in range(5)], 1.5)
        code = "from prism_jax.cli.complete import run; run()"
        job = ["-c", code, f"--output_dir={folder}/out"]
        first = [_seconds(job, folder)]
        yield _row("prism-complete, first run", first, FIRST_SECONDS)
        later = [_seconds(job, folder) for _ in range(3)]
        yield _row("prism-complete, later runs", later, NEXT_SECONDS)


def _row(name: str, seconds: list[float], target: float) -> Row:
    return row(name, seconds, f"{target:g} s", [target], 1.0, unit="s")


def _seconds(arguments: list[str], cache: str) -> float:
    """Of a process that begins with what is in ``cache`` alone."""
    elsewhere = ("JAX_COMPILATION_CACHE_DIR", "PRISM_JAX_CACHE")
    kept = {k: v for k, v in os.environ.items() if k not in elsewhere}
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, *arguments],
        env=kept | {"XDG_CACHE_HOME": cache},
        stdout=subprocess.DEVNULL,
        check=True,
    )
    return time.perf_counter() - start
