"""What a newcomer waits for, measured from outside in fresh processes."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import numpy as np

from experiments.benchmarks.measure import MIB, Row, row
from prism_jax.assets import asset
from prism_jax.io.clouds import read_points

MANY = 5_000_000  # points
COMMAND = ["-c", "from prism_jax.cli.entry import complete; complete()"]
EMBED = """
import jax, numpy as np
from prism_jax import load_pretrained, make_adapt, observe
config, variables = load_pretrained("small")
points = np.random.default_rng(0).normal(size=(512, 3))
seen = observe(points, None, config.model).sampled(512)
adapt = jax.jit(make_adapt(config.with_adapt(num_steps=0)))
adapt.lower(variables, seen.partial, seen.camera).compile()
"""


def suite(scan: str | None = None) -> Iterator[Row]:
    """Import; the first and later runs of the command, of the sample, a scan of a scene
    if one is given, and many points; and what it takes to embed or export."""
    with tempfile.TemporaryDirectory() as cache:
        names = ["-c", "from prism_jax import Completer"]
        yield _row("from prism_jax import Completer", 1.5, [_spent(names, cache)])
        many = f"{cache}/many.npy"
        points = np.asarray(read_points(str(asset("sample.ply"))))
        rng = np.random.default_rng(0)
        near = rng.normal(scale=0.002 * np.ptp(points), size=(MANY, 3))
        np.save(many, (points[np.arange(MANY) % len(points)] + near).astype("f4"))
        jobs = {"prism-complete": ([], 18.0, 3.0), "5 million points": ([many], 40, 20)}
        if scan is not None:
            jobs["a scene"] = [scan], 18.0, 6.0
        for name, (given, first, later) in jobs.items():
            with tempfile.TemporaryDirectory() as own:
                job = [*COMMAND, *given, f"--output_dir={own}/out"]
                yield _row(f"{name}, first run", first, [_spent(job, own)])
                again = [_spent(job, own) for _ in range(3)]
                yield _row(f"{name}, later runs", later, again)
    for name, job in (
        ("make_adapt without steps, compiled", ["-c", EMBED]),
        ("experiments.export", ["-m", "experiments.export", "--output={}/x.jaxexport"]),
    ):
        with tempfile.TemporaryDirectory() as own:
            yield _row(name, 60.0, [_spent([a.format(own) for a in job], own)])


def _row(name: str, target: float, spent: list[tuple[float, float]]) -> Row:
    seconds, peaks = map(list, zip(*spent, strict=True))
    peak = max(peaks)
    bound = f"{target:g} s"
    return row(name, seconds, bound, [target], 1.0, unit="s", peak_mib=peak)


def _spent(arguments: list[str], cache: str) -> tuple[float, float]:
    """Seconds and peak MiB of a process that begins with what is in ``cache`` alone."""
    elsewhere = ("JAX_COMPILATION_CACHE_DIR", "PRISM_JAX_CACHE")
    kept = {k: v for k, v in os.environ.items() if k not in elsewhere}
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *arguments],
        env=kept | {"XDG_CACHE_HOME": cache},
        stdout=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, arguments)
    return seconds, usage.ru_maxrss * 1024 / MIB
