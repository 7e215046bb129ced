"""Files of messages by topic: what every container of ROS messages gives."""

import abc
import contextlib
import pathlib
from collections.abc import Collection, Iterator
from typing import BinaryIO, NamedTuple

from prism_jax.io.errors import InputError, StrPath, unreadable


class Topic(NamedTuple):
    """What is recorded under a name: the messages' type, as `sensor_msgs/msg/Image` or
    without `msg`, how they are encoded, "cdr" or "ros1", and how many there are."""

    kind: str
    encoding: str
    count: int


class Message(NamedTuple):
    """One message as it was recorded, `time` nanoseconds after the clock's zero."""

    topic: str
    time: int
    data: bytes


class CutError(ValueError):
    """A file ends, or turns into something else, before its end; it says how."""


class MessageFile(abc.ABC):
    """One file of messages. What is no such file at all raises InputError."""

    def __init__(self, path: StrPath):
        self.path = pathlib.Path(path)

    @abc.abstractmethod
    def topics(self) -> dict[str, Topic]:
        """All topics of which there is a message, also those of a file that is cut."""

    @abc.abstractmethod
    def messages(self, wanted: Collection[str]) -> Iterator[Message]:
        """Messages of the wanted topics in the order of the file. A file that is cut
        raises `CutError` after the last whole one."""

    @contextlib.contextmanager
    def opened(self, magic: bytes, kind: str) -> Iterator[BinaryIO]:
        """The file, after its first bytes; InputError if these are not the `magic`."""
        with contextlib.ExitStack() as stack:
            try:
                file = stack.enter_context(open(self.path, "rb"))
                start = file.read(len(magic))
            except OSError as error:
                raise unreadable(self.path, error) from None
            if start != magic:
                remedy = "check how it was recorded or copied"
                raise InputError(self.path, f"not {kind}", remedy)
            yield file
