"""Files of messages by topic: what every container of ROS messages gives."""

import abc
import contextlib
import os
import pathlib
from collections import Counter
from collections.abc import Collection, Iterator
from typing import BinaryIO, NamedTuple

from prism_jax.io.errors import InputError, StrPath, unreadable
from prism_jax.io.streams.packed import unpacked_file


class Topic(NamedTuple):
    """What is recorded under a name: the messages' type, as `sensor_msgs/msg/Image` or
    without `msg`, how they are encoded, "cdr" or "ros1", and how many there are."""

    kind: str
    encoding: str
    count: int


class CutError(ValueError):
    """A file ends, or turns into something else, before its end; it says how."""


Source = tuple[str, str, str]  # a topic, its messages' type, and how they are encoded


class MessageFile(abc.ABC):
    """One file of messages, unpacked for as long as it lives if it is a `.zstd`. What
    is no such file at all raises InputError."""

    def __init__(self, path: StrPath):
        self.path = self.file = pathlib.Path(path)
        if self.path.suffix.lower() == ".zstd":
            self.file = unpacked_file(self.path, self)

    @abc.abstractmethod
    def _all(self, told: bool) -> Iterator[tuple[Source, int, bytes | memoryview]]:
        """Each message's source, time and data, in the order of the file; no data if
        these are not `told`. Where the file is cut or damaged, and behind the last
        message if some are missing, a `CutError`."""

    def counts(self) -> Counter[Source]:
        """Messages of each source, as far as they are whole."""
        counts: Counter[Source] = Counter()
        with contextlib.suppress(CutError):  # which iterating over the messages tells
            counts.update(source for source, _, _ in self._all(False))
        return counts

    def messages(self, wanted: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Messages of the wanted topics as they were recorded: topic, nanoseconds after
        the clock's zero, and data. It ends as `_all`."""
        for (topic, *_), time, data in self._all(True):
            if topic in wanted:
                yield topic, time, bytes(data)

    @contextlib.contextmanager
    def opened(self, magic: bytes, kind: str) -> Iterator[BinaryIO]:
        """The file, after its first bytes; InputError if these are not the `magic`. Its
        `size` is that of this moment."""
        with contextlib.ExitStack() as stack:
            try:
                file = stack.enter_context(open(self.file, "rb"))
                self.size = os.fstat(file.fileno()).st_size
                start = file.read(len(magic))
            except OSError as error:
                raise unreadable(self.path, error) from None
            if start != magic:
                remedy = "check how it was recorded or copied"
                raise InputError(self.path, f"not {kind}", remedy)
            yield file
