"""ROS 1 bags of format 2.0: http://wiki.ros.org/Bags/Format/2.0."""

import struct
from collections import Counter
from collections.abc import Iterator
from typing import BinaryIO

from prism_jax.io.streams.messages import CutError, MessageFile, Source, Unpacker

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = (b"%c" % n for n in (2, 3, 5, 6, 7))
_HEADER_LIMIT = 2**20
_Fields = dict[bytes, bytes]


class BagFile(MessageFile):
    """Messages of a bag, packed by bz2, LZ4 or not at all. The index at its end is not
    needed, so a bag that was never closed can be read. If there is one, it tells
    whether messages are missing."""

    def _all(self, told: bool) -> Iterator[tuple[Source, int, memoryview]]:
        sources: dict[int, Source] = {}
        missing: Counter[int] = Counter()  # messages of each connection
        closed = True
        for fields, data in self._records():
            try:
                code = fields[b"op"]
                if code == _BAG:
                    closed = any(fields[b"index_pos"])
                elif code == _CHUNK_INFO:
                    for number, count in struct.iter_unpack("<II", data):
                        missing[number] += count
                elif code == _CONNECTION:
                    (number,) = struct.unpack("<I", fields[b"conn"])
                    kind = _fields(data)[b"type"].decode()
                    sources[number] = fields[b"topic"].decode(), kind, "ros1"
                elif code == _MESSAGE:
                    (number,) = struct.unpack("<I", fields[b"conn"])
                    seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                    missing[number] -= 1
                    yield sources[number], seconds * 10**9 + nanoseconds, data
            except (KeyError, ValueError, struct.error):
                raise CutError("damaged record") from None
        if +missing or not closed:
            lost = f"messages are missing: {(+missing).total():,}"
            raise CutError(lost if closed else "it was never closed")

    def _records(self) -> Iterator[tuple[_Fields, memoryview]]:
        """Every record, those in chunks like the others."""
        with self.opened(MAGIC, "a ROS 1 bag of format 2.0") as file:
            unpacker = Unpacker(self.file)
            while file.tell() < self.size:
                fields, length = _head(file, self.size)
                whole = file.tell() + length <= self.size
                data = memoryview(file.read(min(length, self.size)))
                if fields.get(b"op") == _CHUNK:
                    yield from _in_chunk(fields, data, unpacker)
                elif whole:
                    yield fields, data
                if not whole:
                    raise CutError("ends within a record")


def _head(file: BinaryIO, size: int) -> tuple[_Fields, int]:
    """A record's fields and the length of its data."""
    length = _number(file.read(4))
    if length > min(_HEADER_LIMIT, size):
        raise CutError("damaged record")
    header, length = file.read(length), _number(file.read(4))
    return _fields(memoryview(header)), length


def _number(data: bytes) -> int:
    if len(data) < 4:
        raise CutError("ends within a record")
    return int.from_bytes(data, "little")


def _in_chunk(
    fields: _Fields, data: memoryview, unpacker: Unpacker
) -> Iterator[tuple[_Fields, memoryview]]:
    """The whole records of a chunk, itself whole or not."""
    try:
        (size,) = struct.unpack("<I", fields[b"size"])
        records = unpacker.unpack(data, fields[b"compression"].decode(), size)
        parts = _parts(memoryview(records))
        for header in parts:
            unpacker.count_record()
            content = next(parts, None)
            if header is None or content is None:
                raise CutError("ends within a record")
            yield _fields(header), content
    except (KeyError, struct.error, ValueError) as error:
        raise CutError(f"damaged chunk ({error})") from None


def _parts(data: memoryview) -> Iterator[memoryview | None]:
    """Bytes with their count before them, one after the other; None for bytes that the
    data end within."""
    start = 0
    while start < len(data):
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
