"""Joint positions at the times of frames, from samples before and after them."""

import bisect
import dataclasses
import math
from collections import deque
from collections.abc import Iterator, Mapping

from prism_jax.io.streams.frame import LATE, Frame, Joints

WAITING = 20  # frames that wait for samples at or after their time

_KEPT = 10_000  # samples of each joint


class PlacedFrames:
    """Frames as they come, given in that order as soon as their joints are known.

    Where a clock goes back, all earlier samples are forgotten: they belong to no frame
    after it, whatever its time. A frame's `skew` is the time to the nearest sample of a
    joint in seconds, the longest of all joints.
    """

    def __init__(self, joints: Joints):
        self._gap = round(joints.gap * 1e9)
        self._names = joints.names
        # Times in nanoseconds and positions, by joint.
        self._samples: dict[str, list[tuple[int, float]]] = {}
        self._waiting: deque[Frame] = deque()
        self._times: dict[str, int] = {}  # of the last frame of each sensor
        self._anew = False  # the joints' clock went back, the frames' not yet

    def add_positions(
        self, positions: Mapping[str, float], time: int
    ) -> Iterator[Frame]:
        """Takes samples; gives the frames that waited for them."""
        held = [self._samples.setdefault(name, []) for name in positions]
        if any(samples and time < samples[-1][0] - LATE for samples in held):
            yield from self._forgotten()
            self._anew = True
        for name, value in positions.items():
            samples = self._samples.setdefault(name, [])
            bisect.insort(samples, (time, value))
            del samples[:-_KEPT]
        yield from self.done()

    def add_frame(self, frame: Frame) -> Iterator[Frame]:
        """Takes a frame; gives those that need not wait any longer."""
        before = self._times.get(frame.frame_id, frame.timestamp)
        if frame.timestamp < before - LATE and not self._anew:
            yield from self._forgotten()
        self._anew = False
        self._times[frame.frame_id] = frame.timestamp
        self._waiting.append(frame)
        yield from self.done()

    def done(self, waiting: int = WAITING) -> Iterator[Frame]:
        """Gives the frames of which nothing is missing, and those beyond so many."""
        while self._waiting:
            time = self._waiting[0].timestamp
            known = [self._samples.get(n) for n in self._names or self._samples]
            ready = known and all(held and held[-1][0] >= time for held in known)
            if not ready and len(self._waiting) <= waiting:
                break
            yield self._placed(self._waiting.popleft())

    def _forgotten(self) -> Iterator[Frame]:
        yield from self.done(0)
        self._samples.clear()

    def _placed(self, frame: Frame) -> Frame:
        """The frame with the positions of its time, if they are known."""
        # One that was never told is left out: whoever needs it says its name.
        names = set(self._names or self._samples) & self._samples.keys()
        found = {name: self._at(name, frame.timestamp) for name in names}
        near = {name: at for name, at in found.items() if at is not None}
        if not near or len(near) < len(found):
            return frame
        positions = {name: value for name, (value, _) in near.items()}
        skew = max(away for _, away in near.values()) / 1e9
        return dataclasses.replace(frame, joints={"positions": positions, "skew": skew})

    def _at(self, name: str, time: int) -> tuple[float, int] | None:
        """A joint's position, and how far in time its nearest sample is."""
        samples = self._samples[name]
        place = bisect.bisect_left(samples, (time, -math.inf))
        if place < len(samples) and samples[place][0] == time:
            return samples[place][1], 0
        if not 0 < place < len(samples):
            return None
        (before, start), (after, end) = samples[place - 1 : place + 1]
        if after - before > self._gap:
            return None
        step = end - start
        if abs(step) > math.pi:  # a joint without limits went past half a turn
            step = math.remainder(step, math.tau)
        share = (time - before) / (after - before)
        return start + share * step, min(time - before, after - time)
