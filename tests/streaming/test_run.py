"""Streams of frames: order, pace, faults, and what is counted."""

import threading
import time

import numpy as np
import pytest

from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError
from prism_jax.io.streams import Frame, Stream
from prism_jax.streaming.completer import CompletedFrame, FrameCompleter
from prism_jax.streaming.run import LONGEST_GAP, StreamReport, run_stream

RNG = np.random.default_rng(0)
TENTH = 100_000_000


def shell(number):
    """What is seen from the origin of a box in front of it."""
    points = RNG.uniform([3, -1, -0.5], [4, 1, 0.5], (300 + 40 * number, 3))
    return points.astype(np.float32)


class Listed(Stream):
    """Frames of a list."""

    def __init__(self, frames, fault=None):
        super().__init__("listed", tell=lambda line: None)
        self.frames = frames
        self.fault = fault

    def __len__(self):
        return len(self.frames)

    def _frames(self):
        yield from self.frames
        if self.fault is not None:
            raise self.fault


class Kept:
    """A sink."""

    def __init__(self):
        self.frames, self.closed = [], 0

    def write(self, frame):
        self.frames.append(frame)

    def close(self):
        self.closed += 1


class Instant(FrameCompleter):
    """Completes nothing, and takes its time."""

    def __init__(self, seconds=0.0):
        self.seconds = seconds

    def warm_up(self, frame):
        return self.complete(frame)

    def complete(self, frame):
        if len(frame.points) == 0:
            raise InputError("the frame", "no points", "see the sensor")
        time.sleep(self.seconds)
        label = np.zeros(len(frame.points), np.uint8)
        stages = dict.fromkeys(("observe", "network", "assemble"), self.seconds / 3)
        about = {"workspace": Workspace(np.zeros(3), 1.0), "seconds": stages}
        return CompletedFrame(0, frame.timestamp, frame.points, label, **about)


def frames(count, period=TENTH):
    return [Frame(shell(n % 4), n * period) for n in range(count)]


def test_all_frames_come_in_order_and_are_timed():
    kept = Kept()
    report = run_stream(Listed(frames(25)), Instant(), [kept])
    assert [frame.number for frame in kept.frames] == list(range(25))
    assert [frame.timestamp for frame in kept.frames] == [n * TENTH for n in range(25)]
    assert (report.completed, report.dropped, report.unusable) == (25, 0, 0)
    assert kept.closed == 1
    latency = report.latency()
    assert set(latency) == {"read", "observe", "network", "assemble", "write", "age"}
    for ms in latency.values():
        assert 0 <= ms["p50"] <= ms["p95"] <= ms["p99"] <= ms["max"]


def test_latencies_are_percentiles_of_what_happened():
    report = StreamReport()
    report.times["age"].extend(n / 1000 for n in range(1, 101))
    wanted = {"p50": 51, "p95": 96, "p99": 100, "max": 100}
    assert report.latency() == {"age": pytest.approx(wanted)}


def test_frames_without_points_are_left_out_and_told():
    empty = Frame(np.zeros((0, 3), np.float32), 0)
    nan = Frame(np.zeros((0, 3), np.float32), 0, num_not_finite=9)
    given = [empty, *frames(3), empty, nan, Frame(shell(0), 9 * TENTH)]
    stream, kept = Listed(given), Kept()
    report = run_stream(stream, Instant(), [kept])
    assert [frame.number for frame in kept.frames] == [1, 2, 3, 6]
    assert report.unusable == stream.remarks["unusable"] == 3
    assert stream.remarks["empty"] == 2 and stream.remarks["not_finite"] == 1


def test_at_the_sensors_pace_stale_frames_are_dropped():
    """Fifty frames in half a second, each of which takes 30 ms."""
    stream, kept = Listed(frames(50, TENTH // 10)), Kept()
    start = time.perf_counter()
    report = run_stream(stream, Instant(0.03), [kept], "sensor")
    assert time.perf_counter() - start > 0.49
    assert report.dropped > 10
    assert report.completed + report.dropped == 50
    numbers = [frame.number for frame in kept.frames]
    assert numbers == sorted(numbers) and numbers[-1] == 49
    assert len(set(numbers)) == len(numbers) == report.completed


def test_clocks_that_jump_are_not_waited_for():
    times = [0, 2 * LONGEST_GAP, TENTH, 2 * TENTH]
    stream = Listed([Frame(shell(0), time) for time in times])
    start = time.perf_counter()
    report = run_stream(stream, Instant(), [], "sensor")
    assert time.perf_counter() - start < 5
    assert report.completed + report.dropped == 4
    assert stream.remarks["backward"] == 1


@pytest.mark.parametrize(("of", "pace"), [("s", "max"), ("k", "max"), ("k", "sensor")])
def test_a_fault_of_the_source_or_a_sink_is_the_callers_and_ends_all(of, pace):
    class Full(Kept):
        def write(self, frame):
            if of == "k" and frame.number >= 2:
                raise InputError("out", "cannot be written", "free some space")
            super().write(frame)

    kept, before, report = Full(), threading.active_count(), StreamReport()
    cut = InputError("recording", "is cut", "copy it again") if of == "s" else None
    stream = Listed(frames(40, TENTH // 10)[: 3 if cut else 40], fault=cut)
    with pytest.raises(InputError, match="is cut" if cut else "free some space"):
        run_stream(stream, Instant(0.01), [kept], pace, report=report)
    assert kept.closed == 1 and report.duration > 0
    assert cut is None or [frame.number for frame in kept.frames] == [0, 1, 2]
    assert threading.active_count() <= before
