"""Files of messages by topic: what every container of ROS messages gives, unpacked; of
what is cut, what is there."""

import abc
import bz2
import contextlib
import io
import os
import pathlib
import shutil
import tempfile
import weakref
from collections import Counter
from collections.abc import Collection, Iterator

from prism_jax.io.errors import InputError, StrPath, require, unreadable, unwritable

EXTRA = "stream"
_ZSTD = b"\x28\xb5\x2f\xfd"  # what data packed by zstd begin with
_LARGEST = 2**28  # bytes of a chunk, or of a message that is packed by itself
_TIMES = 4000  # the bytes of a file, unpacked; images of a covered camera have 3,500


class CutError(ValueError):
    """A file ends, or turns into something else, before its end; it says how."""


Source = tuple[str, str, str]
"""A topic, its messages' type, as `sensor_msgs/msg/Image` or without `msg`, and how
they are encoded, "cdr" or "ros1"."""


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
    def opened(self, magic: bytes, kind: str) -> Iterator[io.BufferedIOBase]:
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


class Unpacker:
    """Unpacks what one file holds. Where that is out of all proportion to the file, it
    raises ValueError: a kilobyte of zeros must not keep anybody for minutes."""

    def __init__(self, path: pathlib.Path):
        size = path.stat().st_size
        self._bytes = _LARGEST + _TIMES * size
        self._records = 10_000 + size

    def unpack(self, data: bytes | memoryview, compression: str, size: int) -> bytes:
        """At most ``size`` bytes of packed ones; fewer where these end early.
        ``compression`` is "none" or "", "bz2", "lz4" (in frames) or "zstd". Another
        one, too large a size and damaged data raise ValueError."""
        if compression in ("", "none"):
            return bytes(data[:size])
        if size > min(self._bytes, _LARGEST):
            raise ValueError(f"{size:,} bytes from a file of this size")
        try:
            if compression == "zstd":
                zstd = require("zstandard", EXTRA).ZstdDecompressor()
                unpacked = zstd.stream_reader(io.BytesIO(data)).read(size)
            elif compression == "lz4":
                lz4 = require("lz4.frame", EXTRA).LZ4FrameDecompressor()
                unpacked = lz4.decompress(bytes(data), max_length=size)
            elif compression == "bz2":
                unpacked = bz2.BZ2Decompressor().decompress(bytes(data), size)
            else:
                raise ValueError(f"compression {compression!r} is not supported")
        except InputError:
            raise
        except Exception as error:  # every package has its own
            raise ValueError(str(error)) from None
        self._bytes -= len(unpacked)
        return unpacked

    def count_record(self) -> None:
        """Raises ValueError after too many."""
        self._records -= 1
        if self._records < 0:
            raise ValueError("too many records for its size")

    def message(self, data: bytes) -> bytes:
        """A message as it was before rosbag2 packed it (`compression_mode: MESSAGE`),
        if it did: no message with a header begins like zstd."""
        if not data.startswith(_ZSTD):
            return data
        size = require("zstandard", EXTRA).frame_content_size(data)
        size = min(self._bytes, _LARGEST) if size < 0 else size
        return self.unpack(data, "zstd", size)


def unpacked_file(path: pathlib.Path, owner: object) -> pathlib.Path:
    """A file as it was before rosbag2 packed it (`compression_mode: FILE`), removed
    with its owner. Where it is damaged or far too large, so much of it as there is."""
    zstandard = require("zstandard", EXTRA)
    folder = tempfile.mkdtemp(prefix="prism_jax_")
    weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
    target = pathlib.Path(folder) / path.stem
    left = _LARGEST + _TIMES * path.stat().st_size
    try:
        with open(path, "rb") as packed, open(target, "wb") as file:
            reader = zstandard.ZstdDecompressor().stream_reader(packed)
            with contextlib.suppress(zstandard.ZstdError):
                while left > 0 and (block := reader.read(2**20)):
                    left -= file.write(block)
    except OSError as error:
        raise unwritable(target, error) from None
    return target
