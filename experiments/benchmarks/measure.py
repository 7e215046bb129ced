"""Medians of a function and its peer, taken in turn in one process."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

MIB = 2.0**20


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure, as a ratio to a named peer; lower is better.

    Attributes:
      name: what was measured, and its size.
      ratio: ours over the peer's.
      target: the ratio that is aimed for, or None.
      holds: whether it is reached, or None without a target.
      peer: whose figure the ratio is to.
      ours, theirs: medians, in ``unit``.
      spread: lowest and highest of ours.
      unit: of those.
      compile_seconds: before the first of ours, or None.
      peak_mib: temporary memory of ours, beside arguments and results, or None.
    """

    name: str
    ratio: float
    target: float | None
    holds: bool | None
    peer: str
    ours: float
    theirs: float
    spread: tuple[float, float]
    unit: str = "ms"
    compile_seconds: float | None = None
    peak_mib: float | None = None


def row(
    name: str,
    ours: list[float],
    peer: str,
    theirs: list[float],
    target: float | None = None,
    **more: Any,
) -> Row:
    """A row of two lists of measurements."""
    median, other = float(np.median(ours)), float(np.median(theirs))
    ratio = median / other
    holds = None if target is None else ratio <= target
    spread = (min(ours), max(ours))
    return Row(name, ratio, target, holds, peer, median, other, spread, **more)


class Compiled:
    """A jitted function of fixed arguments, with what its compilation took.

    ``flops`` is the compiler's count: a loop's body counts once, and kernels of our own
    not at all.
    """

    def __init__(self, fn: Callable[..., Any], *arguments: Any):
        start = time.perf_counter()
        self._fn = jax.jit(fn).lower(*arguments).compile()
        self.seconds = time.perf_counter() - start
        self._arguments = arguments
        analysis = self._fn.memory_analysis()
        self.peak_mib = None if analysis is None else analysis.temp_size_in_bytes / MIB
        self.flops = (self._fn.cost_analysis() or {}).get("flops", 0.0)

    def __call__(self) -> Any:
        return jax.block_until_ready(self._fn(*self._arguments))

    @property
    def costs(self) -> dict[str, Any]:
        """Fields of a `Row`."""
        return {"compile_seconds": self.seconds, "peak_mib": self.peak_mib}


def in_turn(*functions: Callable[[], Any], seconds: float = 2.0) -> list[list[float]]:
    """Milliseconds of each function, called one after the other, again and again.

    After one call that is not counted; at least five rounds, and then more until
    ``seconds`` have passed.
    """
    for function in functions:
        function()
    times = [[] for _ in functions]
    start = time.perf_counter()
    while len(times[0]) < 5 or time.perf_counter() - start < seconds:
        for function, taken in zip(functions, times, strict=True):
            before = time.perf_counter()
            function()
            taken.append(1e3 * (time.perf_counter() - before))
    return times
