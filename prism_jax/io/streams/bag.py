"""ROS 1 bags of format 2.0: http://wiki.ros.org/Bags/Format/2.0."""

import contextlib
import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from typing import BinaryIO

from prism_jax.io.streams.messages import CutError, Message, MessageFile, Topic
from prism_jax.io.streams.packed import unpack

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _INDEX, _CHUNK, _CONNECTION = 0x02, 0x04, 0x05, 0x07
_HEADER_LIMIT = 2**20
_Fields = dict[bytes, bytes]


class BagFile(MessageFile):
    """Messages of a bag, packed by bz2, LZ4 or not at all. The index at its end is not
    needed, so a bag that was never closed can be read."""

    def topics(self) -> dict[str, Topic]:
        counts: Counter[str] = Counter()
        kinds: dict[str, str] = {}
        with contextlib.suppress(CutError):  # which iterating over the messages tells
            counts.update(topic for topic, _, _ in self._messages(kinds))
        return {n: Topic(kinds[n], "ros1", count) for n, count in counts.items()}

    def messages(self, wanted: Collection[str]) -> Iterator[Message]:
        for topic, time, data in self._messages({}):
            if topic in wanted:
                yield Message(topic, time, bytes(data))

    def _messages(self, kinds: dict[str, str]) -> Iterator[tuple[str, int, memoryview]]:
        """Each message's topic, time and data. Fills in the types of topics."""
        names: dict[int, str] = {}
        for fields, data in self._records():
            try:
                code = fields[b"op"][0]
                if code == _CONNECTION:
                    (number,) = struct.unpack("<I", fields[b"conn"])
                    names[number] = fields[b"topic"].decode()
                    kinds[names[number]] = _fields(data)[b"type"].decode()
                elif code == _MESSAGE:
                    (number,) = struct.unpack("<I", fields[b"conn"])
                    seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                else:
                    continue
            except (KeyError, IndexError, UnicodeDecodeError, struct.error):
                raise CutError("damaged record") from None
            if code == _MESSAGE and number not in names:
                raise CutError("message without connection")
            if code == _MESSAGE:
                yield names[number], seconds * 1_000_000_000 + nanoseconds, data

    def _records(self) -> Iterator[tuple[_Fields, memoryview]]:
        """Every record, those in chunks like the others."""
        with self.opened(MAGIC, "a ROS 1 bag of format 2.0") as file:
            size = os.fstat(file.fileno()).st_size
            while file.tell() < size:
                fields, length = _head(file, size)
                whole = file.tell() + length <= size
                code = fields.get(b"op", b"\0")[0]
                if code == _CHUNK:
                    data = memoryview(file.read(min(length, size)))
                    yield from _in_chunk(fields, data)
                elif whole and code in (_MESSAGE, _CONNECTION):
                    yield fields, memoryview(file.read(length))
                else:
                    file.seek(length, os.SEEK_CUR)
                if not whole:
                    raise CutError("ends within a record")


def _head(file: BinaryIO, size: int) -> tuple[_Fields, int]:
    """A record's fields and the length of its data."""
    length = _number(file.read(4))
    if length > min(_HEADER_LIMIT, size):
        raise CutError("damaged record")
    header = file.read(length)
    if len(header) < length:
        raise CutError("ends within a record")
    return _fields(memoryview(header)), _number(file.read(4))


def _number(data: bytes) -> int:
    if len(data) < 4:
        raise CutError("ends within a record")
    return int.from_bytes(data, "little")


def _in_chunk(
    fields: _Fields, data: memoryview
) -> Iterator[tuple[_Fields, memoryview]]:
    """The whole records of a chunk, itself whole or not."""
    try:
        (size,) = struct.unpack("<I", fields[b"size"])
        records = memoryview(unpack(data, fields[b"compression"].decode(), size))
    except (KeyError, struct.error, ValueError) as error:
        raise CutError(f"damaged record ({error})") from None
    parts = _parts(records)
    for header in parts:
        content = next(parts, None)
        if header is not None and content is not None:
            yield _fields(header), content


def _parts(data: memoryview) -> Iterator[memoryview | None]:
    """Bytes with their count before them, one after the other; None for bytes that the
    data end within."""
    start = 0
    while start + 4 <= len(data):
        first = start + 4
        start = first + int.from_bytes(data[start:first], "little")
        yield data[first:start] if start <= len(data) else None


def _fields(header: memoryview) -> _Fields:
    """A header's fields by name."""
    fields = {}
    for entry in _parts(header):
        name, equals, value = bytes(entry or b"").partition(b"=")
        if not equals:
            raise CutError("damaged record")
        fields[name] = value
    return fields
