"""MCAP files, as ROS 2 records them: https://mcap.dev/spec."""

import contextlib
import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator

from prism_jax.io.errors import require
from prism_jax.io.streams.messages import CutError, Message, MessageFile, Topic
from prism_jax.io.streams.packed import EXTRA, unpack

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_MOST_A_BYTE = 100
"""Messages: packing does not get further, so statistics that say more are wrong."""


class McapFile(MessageFile):
    """Messages of an MCAP file, chunked or not, packed by zstd, LZ4 or not at all."""

    def topics(self) -> dict[str, Topic]:
        known = _Channels()
        counts = self._counts_at_the_end(known)
        if counts is None:
            counts = Counter()
            # Iterating over the messages tells of what is cut.
            with contextlib.suppress(CutError):
                counts.update(channel for channel, _, _ in self._messages(known))
        found: dict[str, Topic] = {}
        for channel, count in counts.items():
            name, kind, encoding = known.channels[channel]
            before = found[name].count if name in found else 0
            found[name] = Topic(kind, encoding, before + count)
        return found

    def messages(self, wanted: Collection[str]) -> Iterator[Message]:
        known = _Channels()
        for channel, time, data in self._messages(known):
            topic = known.channels[channel][0]
            if topic in wanted:
                yield Message(topic, time, bytes(data))

    def _messages(self, known: "_Channels") -> Iterator[tuple[int, int, memoryview]]:
        """The channel, time and data of each message. Fills in what is known."""
        for code, content in self._records():
            try:
                known.learn(code, content)
                if code != _MESSAGE:
                    continue
                channel, _, time, _ = _MESSAGE_HEAD.unpack_from(content)
            except (struct.error, ValueError) as error:
                raise CutError(f"damaged record ({error})") from None
            if channel not in known.channels:
                raise CutError("message without channel")
            yield channel, time, content[_MESSAGE_HEAD.size :]

    def _records(self) -> Iterator[tuple[int, memoryview]]:
        """Records up to the end of the data, those in chunks like the others."""
        with self.opened(MAGIC, "an MCAP file") as file:
            size = os.fstat(file.fileno()).st_size
            while True:
                head = file.read(_HEAD.size)
                if len(head) < _HEAD.size:
                    raise CutError("no end mark")
                code, length = _HEAD.unpack(head)
                if code == _DATA_END:
                    return
                whole = file.tell() + length <= size
                if not whole and code != _CHUNK:
                    raise CutError("ends within a record")
                content = memoryview(file.read(min(length, size)))
                try:
                    if code == _CHUNK:
                        yield from _in_chunk(content, whole)
                    else:
                        yield code, content
                except (struct.error, UnicodeDecodeError) as error:
                    raise CutError(f"damaged record ({error})") from None
                except ValueError as error:
                    raise CutError(str(error)) from None
                if not whole:
                    raise CutError("ends within a chunk")

    def _counts_at_the_end(self, known: "_Channels") -> dict[int, int] | None:
        """Messages of each channel by the file's own statistics, if there are any."""
        reader = require("mcap.reader", EXTRA)
        try:
            with open(self.path, "rb") as file:
                summary = reader.SeekingReader(file).get_summary()
            counts = summary.statistics.channel_message_counts
        except Exception:  # a file that is cut has none, and fails in many ways
            return None
        for number, channel in summary.channels.items():
            schema = summary.schemas.get(channel.schema_id)
            if schema is None and channel.schema_id:
                return None
            kind = "" if schema is None else schema.name
            known.channels[number] = channel.topic, kind, channel.message_encoding
        most = _MOST_A_BYTE * self.path.stat().st_size
        if not counts.keys() <= known.channels.keys() or sum(counts.values()) > most:
            return None
        return {channel: count for channel, count in counts.items() if count}


class _Channels:
    """What the records that were read say of the channels: topic, type, encoding."""

    def __init__(self):
        self.channels: dict[int, tuple[str, str, str]] = {}
        self._schemas: dict[int, str] = {}

    def learn(self, code: int, content: memoryview) -> None:
        if code == _SCHEMA:
            (number,) = struct.unpack_from("<H", content)
            self._schemas[number] = _text(content, 2)[0]
        elif code == _CHANNEL:
            number, schema = struct.unpack_from("<HH", content)
            topic, end = _text(content, 4)
            encoding, _ = _text(content, end)
            self.channels[number] = topic, self._schemas.get(schema, ""), encoding


def _in_chunk(content: memoryview, whole: bool) -> Iterator[tuple[int, memoryview]]:
    """The records of a chunk; of one that is not whole, those that are."""
    if len(content) < 40:
        return
    (size,) = struct.unpack_from("<Q", content, 16)
    compression, end = _text(content, 28)
    data = memoryview(unpack(content[end + 8 :], compression, size))
    start = 0
    while start + _HEAD.size <= len(data):
        code, length = _HEAD.unpack_from(data, start)
        end = start + _HEAD.size + length
        if end > len(data):
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
