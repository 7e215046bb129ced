"""Chunks of recordings, unpacked; of those that are cut, what is there."""

import bz2
import io

from prism_jax.io.errors import require
from prism_jax.io.files import MAX_FILE_BYTES

EXTRA = "stream"
_ZSTD = b"\x28\xb5\x2f\xfd"  # what data packed by zstd begin with


def unpack(data: bytes | memoryview, compression: str, size: int) -> bytes:
    """At most ``size`` bytes of packed ones; fewer where these end early.
    ``compression`` is "none" or "", "bz2", "lz4" (in frames) or "zstd". Another one, a
    size above `MAX_FILE_BYTES` and damaged data raise ValueError."""
    if size > MAX_FILE_BYTES:
        raise ValueError(f"a chunk of {size:,} bytes is too large")
    if compression in ("", "none"):
        return bytes(data[:size])
    if compression == "zstd":
        zstandard = require("zstandard", EXTRA)
        try:
            reader = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data))
            return reader.read(size)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    try:
        if compression == "lz4":
            unpacker = require("lz4.frame", EXTRA).LZ4FrameDecompressor()
            return unpacker.decompress(bytes(data), max_length=size)
        if compression == "bz2":
            return bz2.BZ2Decompressor().decompress(bytes(data), max_length=size)
    except (OSError, EOFError, RuntimeError) as error:
        raise ValueError(str(error)) from None
    raise ValueError(f"compression {compression!r} is not supported")


def unpacked_message(data: bytes) -> bytes:
    """A message as it was before rosbag2 packed it (`compression_mode: MESSAGE`), if it
    did: no message with a header begins like zstd."""
    if not data.startswith(_ZSTD):
        return data
    size = require("zstandard", EXTRA).frame_content_size(data)
    return unpack(data, "zstd", MAX_FILE_BYTES if size < 0 else size)
