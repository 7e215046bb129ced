"""A whole stream: read ahead, completed and written behind, at its pace or at ours."""

import dataclasses
import itertools
import threading
import time
from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
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

    What the `completer` makes of a frame has `seconds` by stage, and gives by
    `numbered` what the sinks take. At pace "sensor" each frame is given at its time,
    counted from the first, and one that is not taken up before the next is dropped. The
    first usable frame is completed twice, so that compiling makes none late. Frames
    that cannot be completed are remarked and left out. The `report` is filled as frames
    are done, for whoever ends this by an exception; the sinks are closed then, too.
    """
    report = StreamReport() if report is None else report
    numbered = enumerate(iter(stream))
    frames = _Reader(numbered, pace)
    writer = ThreadPoolExecutor(1, "write")
    waiting: deque[Future] = deque()
    start = time.perf_counter()
    try:
        for first in numbered:
            if _completed(*first, stream, completer.warm_up, report) is not None:
                frames.begin(first)
                break
        report.warm_up = time.perf_counter() - start
        start = time.perf_counter()
        for number, frame, read, given in frames:
            report.dropped = frames.dropped
            done = _completed(number, frame, stream, completer.complete, report)
            if done is None:
                continue
            if done.known is not None:
                report.known[number] = done.known
            times = {"read": read, **done.seconds}
            while len(waiting) >= WRITE_BEHIND or (waiting and waiting[0].done()):
                waiting.popleft().result()
            written = done.numbered(number), sinks, report, times, given
            waiting.append(writer.submit(_write, *written))
        while waiting:
            waiting.popleft().result()
    finally:
        frames.stop()
        writer.shutdown()
        report.dropped = frames.dropped
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


class _Reader:
    """Frames with their numbers, the seconds they took to read, and when they were
    given; read ahead in a thread."""

    def __init__(self, numbered: Iterator[tuple[int, Frame]], pace: Pace):
        self.dropped = 0
        self._numbered = numbered
        self._paced = pace == "sensor"
        self._ready: deque[tuple[int, Frame, float, float]] = deque()
        self._changed = threading.Condition()
        self._ended = threading.Event()
        self._fault: BaseException | None = None
        self._thread: threading.Thread | None = None

    def begin(self, first: tuple[int, Frame]) -> None:
        """Starts the clock with a frame that was read already."""
        self._numbered = itertools.chain([first], self._numbered)
        self._thread = threading.Thread(target=self._read, daemon=True, name="read")
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread, in the middle of the stream if need be."""
        with self._changed:
            self._ended.set()
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def __iter__(self) -> Iterator[tuple[int, Frame, float, float]]:
        while self._thread is not None:
            with self._changed:
                self._changed.wait_for(lambda: self._ready or self._ended.is_set())
                if not self._ready:
                    break
                number, frame, read, given = self._ready.popleft()
                self._changed.notify_all()
            yield number, frame, read, given if self._paced else time.perf_counter()
        if self._fault is not None:
            raise self._fault

    def _read(self) -> None:
        try:
            due, before = time.perf_counter(), None
            while not self._ended.is_set():
                start = time.perf_counter()
                number, frame = next(self._numbered, (None, None))
                if number is None or frame is None:
                    break
                read = time.perf_counter() - start
                gap = 0 if before is None else frame.timestamp - before
                before = frame.timestamp
                if self._paced and 0 < gap <= LONGEST_GAP:
                    due += gap / 1e9
                if self._paced:
                    self._ended.wait(max(due - time.perf_counter(), 0.0))
                self._hand_over((number, frame, read, due))
        except BaseException as error:
            self._fault = error
        with self._changed:
            self._ended.set()
            self._changed.notify_all()

    def _hand_over(self, item: tuple[int, Frame, float, float]) -> None:
        with self._changed:
            if self._paced:
                self.dropped += len(self._ready)
                self._ready.clear()
            else:
                self._changed.wait_for(
                    lambda: len(self._ready) < READ_AHEAD or self._ended.is_set()
                )
            self._ready.append(item)
            self._changed.notify_all()
