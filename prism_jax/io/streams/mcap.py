"""MCAP files, as ROS 2 records them: https://mcap.dev/spec."""

import contextlib
import struct
import zlib
from collections import Counter
from collections.abc import Iterator

from prism_jax.io.streams.messages import CutError, MessageFile, Source, Unpacker

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_STATISTICS = 0x0B
_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_FOOTER = struct.Struct("<BQQQI8s")  # and the magic behind it
_LONGEST_SUMMARY = 2**28  # bytes
_MOST_A_BYTE = 100  # messages: statistics that say more are wrong
_Record = tuple[int, memoryview]  # its kind and its content


class McapFile(MessageFile):
    """Messages of an MCAP file, chunked or not, packed by zstd, LZ4 or not at all. Its
    checksums and its statistics tell what is damaged, and whether messages are
    missing."""

    def counts(self) -> Counter[Source]:
        """By what the end of the file says, if it is sound; else by all messages."""
        counts: Counter[Source] = Counter()
        faults = KeyError, struct.error, ValueError
        with self.opened(MAGIC, "an MCAP file") as file, contextlib.suppress(*faults):
            file.seek(max(self.size - _FOOTER.size, 0))
            start = _FOOTER.unpack(file.read())[2]
            if 0 < self.size - start < _LONGEST_SUMMARY:
                file.seek(start)
                known = _Known().learn_summary(memoryview(file.read()))
                for number, count in known.counts.items():
                    counts[known.channels[number]] += count
                sound = all(kind for _, kind, _ in counts)
                if sound and 0 < counts.total() <= _MOST_A_BYTE * self.size:
                    return counts
        return super().counts()

    def _all(self, told: bool) -> Iterator[tuple[Source, int, memoryview]]:
        known, missing = _Known(), Counter()
        counts: Counter[int] = Counter()
        for code, content in self._records():
            try:
                if code == _MESSAGE:
                    number, _, time, _ = _MESSAGE_HEAD.unpack_from(content)
                    counts[number] += 1
                    yield known.channels[number], time, content[_MESSAGE_HEAD.size :]
                elif code == _DATA_END:
                    missing = known.learn_summary(content).counts - counts
                else:
                    known.learn(code, content)
            except (KeyError, struct.error, ValueError) as error:
                raise CutError(f"damaged record ({error})") from None
        if missing:
            raise CutError(f"messages are missing: {missing.total():,}")

    def _records(self) -> Iterator[_Record]:
        """Records up to the end of the data, those in chunks like the others; of that
        the content is all behind it."""
        checksum = zlib.crc32(MAGIC)
        with self.opened(MAGIC, "an MCAP file") as file:
            unpacker = Unpacker(self.file)
            while True:
                head = file.read(_HEAD.size)
                if len(head) < _HEAD.size:
                    raise CutError("no end mark")
                code, length = _HEAD.unpack(head)
                whole = file.tell() + length <= self.size
                if not whole and code != _CHUNK:
                    raise CutError("ends within a record")
                content = memoryview(file.read(min(length, self.size)))
                if code == _DATA_END:
                    if int.from_bytes(content[:4], "little") not in (0, checksum):
                        raise CutError("a checksum is wrong")
                    yield code, memoryview(file.read(_LONGEST_SUMMARY))
                    return
                checksum = zlib.crc32(content, zlib.crc32(head, checksum))
                try:
                    records = iter([(code, content)])
                    if code == _CHUNK:
                        records = _in_chunk(content, whole, unpacker)
                    for record in records:
                        unpacker.count_record()
                        yield record
                except (struct.error, ValueError) as error:
                    raise CutError(f"damaged chunk ({error})") from None
                if not whole:
                    raise CutError("ends within a chunk")


class _Known:
    """What the records that were read say of the channels: topic, type, encoding; and
    how many messages each has."""

    def __init__(self):
        self.channels: dict[int, Source] = {}
        self.counts: Counter[int] = Counter()
        self._schemas: dict[int, str] = {}

    def learn(self, code: int, content: memoryview) -> None:
        if code == _SCHEMA:
            (number,) = struct.unpack_from("<H", content)
            self._schemas[number] = _text(content, 2)[0]
        elif code == _CHANNEL:
            number, schema = struct.unpack_from("<HH", content)
            topic, end = _text(content, 4)
            encoding, _ = _text(content, end)
            found = topic, self._schemas.get(schema, ""), encoding
            if self.channels.setdefault(number, found) != found:
                raise ValueError("a channel changes")
        elif code == _STATISTICS:
            self.counts = +Counter(dict(struct.iter_unpack("<HQ", content[46:])))

    def learn_summary(self, summary: memoryview) -> "_Known":
        """All that is behind the data. ValueError or struct.error if it is damaged."""
        *_, checksum, magic = _FOOTER.unpack(summary[-_FOOTER.size :])
        if magic != MAGIC or checksum not in (0, zlib.crc32(summary[:-12])):
            raise ValueError("its summary is damaged")
        for record in _split(summary[: -_FOOTER.size]):
            self.learn(*record)
        return self


def _in_chunk(
    content: memoryview, whole: bool, unpacker: Unpacker
) -> Iterator[_Record]:
    """The records of a chunk; of one that is not whole, those that are. What is damaged
    raises ValueError."""
    if not whole and len(content) < 40:
        return
    size, checksum = struct.unpack_from("<QI", content, 16)
    compression, end = _text(content, 28)
    data = memoryview(unpacker.unpack(content[end + 8 :], compression, size))
    if whole and len(data) < size:
        raise ValueError("a chunk is shorter than it says")
    if whole and checksum not in (0, zlib.crc32(data)):
        raise ValueError("a checksum is wrong")
    yield from _split(data, whole)


def _split(data: memoryview, whole: bool = True) -> Iterator[_Record]:
    """Records one after the other. Behind the last there must be nothing if they are
    whole."""
    start = 0
    while start + _HEAD.size <= len(data):
        code, length = _HEAD.unpack_from(data, start)
        end = start + _HEAD.size + length
        if end > len(data) or code == 0:
            break
        yield code, data[start + _HEAD.size : end]
        start = end
    if whole and start < len(data):
        raise ValueError("a chunk ends within a record")


def _text(content: memoryview, start: int) -> tuple[str, int]:
    """A string and where it ends."""
    (length,) = struct.unpack_from("<I", content, start)
    end = start + 4 + length
    if end > len(content):
        raise ValueError("a string is longer than its record")
    return bytes(content[start + 4 : end]).decode(), end
