"""A whole stream: read ahead, completed and written behind, at its pace or at ours."""

import contextlib
import dataclasses
import itertools
import queue
import threading
import time
from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Literal

import numpy as np

from prism_jax.io.errors import InputError
from prism_jax.io.streams.frame import Frame, Stream
from prism_jax.io.streams.sinks import Sink
from prism_jax.streaming.observer import FrameObserver

Pace = Literal["max", "sensor"]

READ_AHEAD = 2  # frames that are read before their turn, at pace "max"

WRITE_BEHIND = 4  # frames that may wait for being written

LONGEST_GAP = 10_000_000_000
"""Nanoseconds: a longer gap between two frames is not waited for."""


@dataclasses.dataclass
class StreamReport:
    """What came of a stream; lengths of time in seconds."""

    completed: int = 0  # frames that were completed and written
    dropped: int = 0  # frames that a newer one overtook, at the sensor's pace
    unusable: int = 0  # frames with nothing to complete
    # Until the first frame was done for the first time, compilation included.
    warm_up: float = 0.0
    duration: float = 0.0  # from then on
    # When each completed frame was measured, in nanoseconds, by its number.
    timestamps: dict[int, int] = dataclasses.field(default_factory=dict)
    # Which known model a frame holds, its pose, and how far it moved since the last
    # one that held it, by the frame's number.
    known: dict[int, dict[str, Any]] = dataclasses.field(default_factory=dict)
    # By stage, of each completed frame: "read", those of what completes it, "write",
    # and its "age" when it is written, since the sensor gave it or it was taken up.
    times: dict[str, array] = dataclasses.field(
        default_factory=lambda: defaultdict(lambda: array("d"))
    )

    def latency(self) -> dict[str, dict[str, float]]:
        """Milliseconds by stage: the 50th, 95th and 99th percentile, and the most."""
        found = {}
        for stage, seconds in self.times.items():
            ms = 1e3 * np.asarray(seconds)
            ranks = np.percentile(ms, [50, 95, 99, 100], method="higher")
            names = ("p50", "p95", "p99", "max")
            found[stage] = dict(zip(names, ranks.tolist(), strict=True))
        return found


def run_stream(
    stream: Stream,
    completer: FrameObserver,
    sinks: Sequence[Sink] = (),
    pace: Pace = "max",
    report: StreamReport | None = None,
) -> StreamReport:
    """Completes a stream's frames and hands each to the sinks, in order.

    What the `completer` makes of a frame has `seconds` by stage, and the sinks take it
    with its `number`. At pace "sensor" each frame is given at its time,
    counted from the first, and one that is not taken up before the next is dropped. The
    first usable frame is completed twice, so that compiling makes none late. Frames
    that cannot be completed are remarked and left out. The `report` is filled as frames
    are done, for whoever ends this by an exception; the sinks are closed then, too.
    """
    report = StreamReport() if report is None else report
    numbered = enumerate(iter(stream))
    writer = ThreadPoolExecutor(1, "write")
    waiting: deque[Future] = deque()
    start = time.perf_counter()
    try:
        for first in numbered:
            if _completed(*first, stream, completer.warm_up, report) is not None:
                numbered = itertools.chain([first], numbered)
                break
        report.warm_up = time.perf_counter() - start
        start = time.perf_counter()
        with contextlib.closing(_ahead(numbered, pace == "sensor", report)) as frames:
            for number, frame, read, given in frames:
                done = _completed(number, frame, stream, completer.complete, report)
                if done is None:
                    continue
                if done.known is not None:
                    report.known[number] = done.known
                times = {"read": read, **done.seconds}
                while len(waiting) >= WRITE_BEHIND or (waiting and waiting[0].done()):
                    waiting.popleft().result()
                done = dataclasses.replace(done, number=number)
                written = done, sinks, report, times, given
                waiting.append(writer.submit(_write, *written))
        while waiting:
            waiting.popleft().result()
    finally:
        writer.shutdown()
        report.duration = time.perf_counter() - start
        for sink in sinks:
            sink.close()
    return report


def _completed(
    number: int,
    frame: Frame,
    stream: Stream,
    complete: Callable[[Frame], Any],
    report: StreamReport,
) -> Any:
    try:
        return complete(frame)
    except InputError as error:
        report.unusable += 1
        stream.remark("unusable", f"skipped frame {number}: {error}")
        return None


def _write(
    frame: Any,
    sinks: Sequence[Sink],
    report: StreamReport,
    times: dict[str, float],
    given: float,
) -> None:
    start = time.perf_counter()
    for sink in sinks:
        sink.write(frame)
    end = time.perf_counter()
    report.completed += 1
    report.timestamps[frame.number] = frame.timestamp
    for stage, seconds in (times | {"write": end - start, "age": end - given}).items():
        report.times[stage].append(seconds)


def _ahead(
    numbered: Iterator[tuple[int, Frame]], paced: bool, report: StreamReport
) -> Generator[tuple[int, Frame, float, float], None, None]:
    """Frames with their numbers, the seconds they took to read, and when they were
    given; read ahead in a thread. It ends when this is closed, in the middle of the
    stream if need be."""
    ready: queue.SimpleQueue[Any] = queue.SimpleQueue()
    room, ended = threading.Semaphore(READ_AHEAD), threading.Event()

    def read() -> None:
        due, before = time.perf_counter(), None
        try:
            while not ended.is_set():
                start = time.perf_counter()
                number, frame = next(numbered, (None, None))
                if frame is None:
                    break
                took = time.perf_counter() - start
                gap = 0 if before is None else frame.timestamp - before
                before = frame.timestamp
                if paced and 0 < gap <= LONGEST_GAP:
                    due += gap / 1e9
                if paced:
                    ended.wait(max(due - time.perf_counter(), 0.0))
                    with contextlib.suppress(queue.Empty):
                        ready.get_nowait()
                        report.dropped += 1
                else:
                    room.acquire()
                ready.put((number, frame, took, due))
        finally:
            ready.put(None)

    thread = ThreadPoolExecutor(1, "read")
    reading = thread.submit(read)
    try:
        for number, frame, took, due in iter(ready.get, None):
            room.release()
            yield number, frame, took, due if paced else time.perf_counter()
        reading.result()  # raises what reading did
    finally:
        ended.set()
        room.release()
        thread.shutdown()
