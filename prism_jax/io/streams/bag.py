"""ROS 1 bags of format 2.0: http://wiki.ros.org/Bags/Format/2.0."""

import io
import struct
from collections import Counter
from collections.abc import Iterator

from prism_jax.io.streams.messages import CutError, MessageFile, Source, Unpacker

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = (b"%c" % n for n in (2, 3, 5, 6, 7))
_HEADER_LIMIT = 2**20
_Fields = dict[bytes, bytes]


class BagFile(MessageFile):
    """Messages of a bag, packed by bz2, LZ4 or not at all. The index at its end is not
    needed, so a bag that was never closed can be read. If there is one, it tells
    whether messages are missing."""

    def _all(self, told: bool) -> Iterator[tuple[Source, int, bytes]]:
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

    def _records(self) -> Iterator[tuple[_Fields, bytes]]:
        """Every record, those in chunks like the others."""
        with self.opened(MAGIC, "a ROS 1 bag of format 2.0") as file:
            unpacker = Unpacker(self.file)
            for fields, data, is_whole in _split(file, self.size):
                if fields.get(b"op") == _CHUNK:
                    yield from _in_chunk(fields, data, unpacker)
                elif is_whole:
                    yield fields, data
                if not is_whole:
                    raise CutError("ends within a record")


def _split(file: io.BufferedIOBase, size: int) -> Iterator[tuple[_Fields, bytes, bool]]:
    """Records one after the other: fields, data, and whether these are whole."""
    while file.tell() < size:
        length = _number(file)
        if length > _HEADER_LIMIT:
            raise CutError("damaged record")
        header, length = file.read(length), _number(file)
        is_whole = file.tell() + length <= size
        yield _fields(header), file.read(min(length, size)), is_whole


def _number(file: io.BufferedIOBase) -> int:
    data = file.read(4)
    if len(data) < 4:
        raise CutError("ends within a record")
    return int.from_bytes(data, "little")


def _in_chunk(
    fields: _Fields, data: bytes, unpacker: Unpacker
) -> Iterator[tuple[_Fields, bytes]]:
    """The whole records of a chunk, itself whole or not."""
    try:
        (size,) = struct.unpack("<I", fields[b"size"])
        records = unpacker.unpack(data, fields[b"compression"].decode(), size)
        for own, content, is_whole in _split(io.BytesIO(records), len(records)):
            unpacker.count_record()
            if not is_whole:
                raise CutError("ends within a record")
            yield own, content
    except (KeyError, struct.error, ValueError) as error:
        raise CutError(f"damaged chunk ({error})") from None


def _fields(header: bytes) -> _Fields:
    """A header's fields by name, each with its length before it."""
    fields, start = {}, 0
    while start < len(header):
        first = start + 4
        start = first + int.from_bytes(header[start:first], "little")
        name, equals, value = header[first:start].partition(b"=")
        if not equals or start > len(header):
            raise CutError("damaged record")
        fields[name] = value
    return fields
