"""A recording of ten frames a second: the age of results, and flat memory."""

import dataclasses
import os
import pathlib
import tempfile
from collections.abc import Iterator

import numpy as np

from experiments.benchmarks.measure import MIB, Row
from experiments.simulation.roboarm.recording import write_mcap
from prism_jax.completion.completer import Completer
from prism_jax.data.recordings import RecordedCells, RecordedFrame
from prism_jax.io.scan import Bounds
from prism_jax.io.streams import Frame, Stream, open_stream
from prism_jax.io.streams.sinks import Labelled, open_sink
from prism_jax.streaming.completer import FrameCompleter
from prism_jax.streaming.run import run_stream

RATE = 10.0
RECORDED = 50
PACED, FLAT = 600, 10_000
"""Frames at the sensor's pace, and as fast as it goes."""

AGE = 100.0
"""Milliseconds that the 99th percentile of the age may be."""

GROWTH = 1.05
"""What memory after the last frame may be, in units of that after a tenth of them."""


class Repeated(Stream):
    """A recording that begins anew until there are so many frames."""

    def __init__(self, stream: Stream, count: int):
        super().__init__(stream.path)
        self._stream = stream
        self._count = count

    def __len__(self) -> int:
        return self._count

    def _frames(self) -> Iterator[Frame]:
        number = 0
        while True:
            for frame in self._stream:
                if number == self._count:
                    return
                time = round(number * 1e9 / RATE)
                yield dataclasses.replace(frame, timestamp=time)
                number += 1


class Meter:
    """A sink that looks at the process's memory."""

    def __init__(self):
        self.mib: list[float] = []

    def write(self, frame: Labelled) -> None:
        pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
        self.mib.append(pages * os.sysconf("SC_PAGESIZE") / MIB)

    def close(self) -> None:
        pass


def suite(weights: str = "small") -> Iterator[Row]:
    """A depth camera of 640x480 pixels that sees a robot cell, read from MCAP and
    written to it. Linux alone tells the memory."""
    frame = RecordedCells.bundled().read(0)
    lower, upper = frame.partial.min(axis=0), frame.partial.max(axis=0)
    completer = FrameCompleter(
        Completer.from_pretrained(weights), bounds=Bounds(lower, upper)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "cell.mcap"
        write_mcap(path, _noisy(frame), RATE)
        stream = open_stream(path, camera=frame.camera)
        out = open_sink(path.with_name("out.mcap"))
        report = run_stream(Repeated(stream, PACED), completer, [out], "sensor")
        ages = 1e3 * np.asarray(report.times["age"])
        age = report.latency()["age"]["p99"]
        told = f"p99 age of {PACED} frames, {report.dropped} dropped"
        yield Row(
            name=told,
            ratio=age / AGE,
            target=1.0,
            holds=age <= AGE and report.dropped == 0,
            peer="the sensor's period",
            ours=age,
            theirs=AGE,
            spread=(float(ages.min()), float(ages.max())),
            compile_seconds=report.warm_up,
        )
        meter = Meter()
        out = open_sink(path.with_name("out.mcap"))
        run_stream(Repeated(stream, FLAT), completer, [out, meter])
        early, late = meter.mib[FLAT // 10], meter.mib[-1]
        yield Row(
            name=f"memory after {FLAT:,} frames",
            ratio=late / early,
            target=GROWTH,
            holds=late / early <= GROWTH,
            peer=f"after {FLAT // 10:,}",
            ours=late,
            theirs=early,
            spread=(min(meter.mib), max(meter.mib)),
            unit="MiB",
        )


def _noisy(cell: RecordedFrame) -> Iterator[RecordedFrame]:
    """The cell with noise of 2 mm, another for each frame."""
    rng = np.random.default_rng(0)
    for _ in range(RECORDED):
        noise = rng.integers(-8, 9, cell.depth.shape)
        depth = np.where(cell.depth, cell.depth + noise, 0).astype(np.uint16)
        yield dataclasses.replace(cell, depth=depth)
